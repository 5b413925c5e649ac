"""A sphere on a flat face."""

from derender.scene.contacts.base import contacts
from derender.scene.contacts.face_to_face import Tilted


@contacts.register("point-on-face")
class PointOnFace(Tilted):
    """A sphere touches a flat face in one point: u, v (on a plane x, y). Its rotation shows nothing and is slack."""

    compiled_code = 2
    child_features = "point_names"
