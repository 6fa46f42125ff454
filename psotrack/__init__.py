"""psotrack: 3D positions of several drones, in every frame, from calibrated camera videos alone.

The flow is one way: video -> foreground -> silhouettes -> tracker -> trajectories -> evaluation. Importing the
package has no effects: no device is chosen, no setting of JAX is touched.
"""

from importlib.metadata import version as _version

__version__ = _version("psotrack")
