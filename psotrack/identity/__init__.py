"""Who is who after drones have met: tracks that may have exchanged their drones, and what to do about it.

Two drones that come near each other share silhouettes, and a tracker may leave them with the wrong labels. So from
when they come near until the views have separated them, every labelling is kept with motion states of its own
(`labellings`): those before the meeting predict, what is measured during and after it decides. A sudden exchange is a
jump of both tracks, a slow one a change of course that the motion model does not expect, and apparent sizes tell
drones apart that are not alike. When the labelling is as good as certain, it is settled: tracks are exchanged from the
frame on in which that makes the most frames right.

A frame is judged by itself and the frames before it alone, and what is settled stays. So `resolve` of the first
frames of a recording yields what `resolve` of all of it yields there, up to the first frame of an encounter that is
still open; and of what is before that frame it needs no more than the tracks, to go on.
"""

from psotrack.identity.records import Encounter, Identities, IdentityParams, Outcome, relabelled
from psotrack.identity.resolving import resolve

__all__ = ["Encounter", "Identities", "IdentityParams", "Outcome", "relabelled", "resolve"]
