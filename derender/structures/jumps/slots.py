"""The image of scenes whose solids come and go: an engine with places in reserve, so that a jump costs what it changes.

The engine is made for a fixed list of solids. Here it has places for several solids of each kind; those in reserve
stand behind the camera, where they cover no pixel. Birth moves one into view, death one out of it, and only what stands
elsewhere than before is drawn again.
"""

import numpy as np

from derender.render.raycast.evaluator import DepthEvaluator
from derender.scene.graph import SceneGraph
from derender.scene.solids import BOX, CYLINDER, PLANE, SPHERE, Solids

RESERVE = 6  # places of each kind beyond what a scene holds when the engine is made
BEHIND = np.eye(4)
BEHIND[2, 3] = -1e3
SMALL = np.full(3, 1e-3)


class SlotImage:
    """Log likelihoods of scenes by difference. `propose(graph)`, then `accept()` or `reject()`.

    Parameters
    ----------
    camera, observed (H, W), likelihood, values : as of `DepthEvaluator`.
    """

    def __init__(self, camera, observed: np.ndarray, likelihood: str = "gaussian", values=None) -> None:
        self._arguments = camera, observed, likelihood, values
        self._evaluator: DepthEvaluator | None = None
        self._keys: list[tuple[int, int]] = []  # (kind, mesh) of each place
        self._meshes: tuple = ()
        self._poses = np.zeros((0, 4, 4))
        self._sizes = np.zeros((0, 3))
        self._here: dict[str, int] = {}  # places by name in the current scene
        self._next: tuple = ()
        self._density = 0.0
        self.evaluations = 0

    def propose(self, graph: SceneGraph) -> float:
        """Return the log likelihood of a scene."""
        solids, names = graph.solids(), graph.solid_names
        if len(solids.meshes):
            return self._propose_whole(solids)
        here = self._assign(names, solids)
        if here is None:
            self._make(names, solids)
            here = self._assign(names, solids)
        assert here is not None and self._evaluator is not None, "the engine was made for as many"
        poses, sizes = self._poses, self._sizes
        moved, new_poses, new_sizes = [], [], []
        for place, pose, size in zip(here.values(), solids.pose, solids.size, strict=True):
            if not (np.array_equal(poses[place], pose) and np.array_equal(sizes[place], size)):
                moved.append(place)
                new_poses.append(pose)
                new_sizes.append(size)
        used = set(here.values())
        for place in self._here.values():
            if place not in used:
                moved.append(place)
                new_poses.append(BEHIND)
                new_sizes.append(SMALL if self._keys[place][0] != PLANE else np.zeros(3))
        self.evaluations += 1
        if not moved:
            self._next = here, (), (), (), self._density
            return self._density
        density = self._evaluator.propose(moved, np.array(new_poses), np.array(new_sizes))
        self._next = here, moved, new_poses, new_sizes, density
        return density

    def accept(self) -> None:
        """Make the scene proposed the current one."""
        if not self._next:
            return
        here, moved, poses, sizes, self._density = self._next
        for place, pose, size in zip(moved, poses, sizes, strict=True):
            self._poses[place], self._sizes[place] = pose, size
        if moved and self._evaluator is not None:
            self._evaluator.accept()
        self._here = here

    def reject(self) -> None:
        """Forget the scene proposed."""
        if self._next and self._next[1] and self._evaluator is not None:
            self._evaluator.reject()

    def _propose_whole(self, solids: Solids) -> float:
        """Return the log likelihood of a scene with meshes, in full: each mesh has a picture of its own there."""
        if self._evaluator is None:
            self._evaluator = DepthEvaluator(*self._arguments)
        self._next = ()
        self.evaluations += 1
        return self._evaluator.load(solids)

    def _assign(self, names, solids: Solids) -> dict[str, int] | None:
        """Return a place for each solid: its own where its kind is the same; None where the places do not suffice."""
        if self._evaluator is None:
            return None
        here: dict[str, int] = {}
        taken = set()
        for name, kind in zip(names, solids.kind, strict=True):
            place = self._here.get(name)
            if place is not None and self._keys[place][0] == kind:
                here[name] = place
                taken.add(place)
        free = [place for place in range(len(self._keys)) if place not in taken]
        occupied = set(self._here.values())
        free.sort(key=lambda place: place in occupied)  # empty places first: fewer rectangles change
        for name, kind in zip(names, solids.kind, strict=True):
            if name not in here:
                place = next((p for p in free if self._keys[p][0] == kind), None)
                if place is None:
                    return None
                free.remove(place)
                here[name] = place
        return {name: here[name] for name in names}

    def _make(self, names, solids: Solids) -> None:
        """Make an engine with places for a scene and more; the current scene stays the current one."""
        kinds: list[int] = []
        for kind in (PLANE, BOX, SPHERE, CYLINDER):
            present = int(np.sum(solids.kind == kind))
            before = sum(self._keys[place][0] == kind for place in self._here.values())
            kinds += [kind] * (max(present, before) + (RESERVE if kind != PLANE else 0))
        poses, sizes = np.repeat(BEHIND[None], len(kinds), 0), np.repeat(SMALL[None], len(kinds), 0)
        sizes[np.array(kinds) == PLANE] = 0.0
        old, here = self._here, {}
        keys = [(kind, -1) for kind in kinds]
        for name, place in old.items():
            new = next(p for p, key in enumerate(keys) if key == self._keys[place] and p not in here.values())
            poses[new], sizes[new], here[name] = self._poses[place], self._sizes[place], new
        self._keys, self._poses, self._sizes, self._here = keys, poses, sizes, here
        self._evaluator = DepthEvaluator(*self._arguments)
        numbers, mesh = np.array(kinds, np.int32), np.full(len(kinds), -1, np.int32)
        self._density = self._evaluator.load(Solids(numbers, poses, sizes, mesh, ()))
