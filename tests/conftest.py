"""Session-wide switches that turn silent trouble into failures.

jaxtyping and beartype check every annotated call of the package (`--jaxtyping-packages` in pyproject.toml).
"""

import importlib
import os
import pkgutil

# Whose window is how wide, and where somebody has JAX keep programs, decides no test. Before JAX looks.
os.environ["COLUMNS"] = "80"
os.environ.pop("JAX_COMPILATION_CACHE_DIR", None)

import jax
import pytest
from hypothesis import HealthCheck, settings

# int32 + float32 and the like must be written out: a promotion that nobody meant is how exact sums lose bits.
# Rank promotion stays allowed: particles x drones x cameras broadcast against cameras everywhere, on purpose.
jax.config.update("jax_numpy_dtype_promotion", "strict")

# Batches of runs are shared by two devices, as they are on machines that have them.
jax.config.update("jax_num_cpu_devices", 2)

# The same examples in every run: a failure can be repeated, and no test throws a coin. No deadline, because the
# first example of a compiled function pays for the compiler; and nobody minds how long a slow machine draws them.
settings.register_profile(
    "psotrack",
    derandomize=True,
    deadline=None,
    max_examples=40,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.load_profile("psotrack")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Files with slow tests first: begun last, one of them would leave all other processes without work.

    And all of the package is imported: Hypothesis also draws the numbers that it finds in imported modules, which would
    be other ones after other tests.
    """
    import psotrack

    for module in pkgutil.walk_packages(psotrack.__path__, "psotrack."):
        if not module.name.endswith("__main__"):
            importlib.import_module(module.name)
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: item.path not in slow)
