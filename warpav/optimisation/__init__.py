"""Where the cameras go: mount poses, constraints, the objective, and the searches for a rig.

Shapes that every module shares: mount poses are float [camera, 7] as `_mount` counts them, detection probabilities
float [camera, object] with the objects scene by scene, weights of objects float [object], and None where all are alike.
"""

from warpav.core.face import face_of

__all__, __getattr__ = face_of(__name__)  # pyright: ignore[reportUnsupportedDunderAll]
