from .samples import Samples
from .settings import TrainSettings
from .training import train, train_on_sequences

__all__ = ["Samples", "TrainSettings", "train", "train_on_sequences"]
