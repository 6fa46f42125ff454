from .finding import FINDING_VERSION, USUAL_CONFIDENCE, boxes_of, findings, padded, peaks_of
from .model_file import Model, from_bytes, head_of, model_at, to_bytes, write_model
from .names import MODEL_SUFFIX, NETWORK, model_path
from .network import CELL_PX, Found, Network, inputs_of, untrained
from .onnx_file import write_onnx

__all__ = [
    "CELL_PX",
    "FINDING_VERSION",
    "MODEL_SUFFIX",
    "NETWORK",
    "USUAL_CONFIDENCE",
    "Found",
    "Model",
    "Network",
    "boxes_of",
    "findings",
    "from_bytes",
    "head_of",
    "inputs_of",
    "model_at",
    "model_path",
    "padded",
    "peaks_of",
    "to_bytes",
    "untrained",
    "write_model",
    "write_onnx",
]
