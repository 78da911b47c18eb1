"""Names of what has none in the description: free joints, and the sites that loops close at."""

from __future__ import annotations

from collections.abc import Iterator

from wheelleg_exp.asset.description import Closure, Pose, RobotDescription
from wheelleg_exp.asset.naming import Numbered


class Names:
    """Names that clash with no other of the robot's."""

    def __init__(self, robot: RobotDescription) -> None:
        joints = Numbered(dof.name for dof in robot.dofs)
        sites = Numbered(s.name for s in (*robot.static_sites, *(s for body in robot.bodies for s in body.sites)))
        equalities = Numbered(coupling.name for coupling in robot.couplings)
        self._free = {body.name: joints.take(f"{body.name}_free") for body in robot.bodies if body.floating}
        self._closures: dict[str, list[tuple[str, str, str]]] = {}
        self._anchors: dict[str | None, list[tuple[str, Pose]]] = {}
        for closure in robot.closures:
            self._closure(closure, sites, equalities)

    def free_joint(self, body: str) -> str:
        """Return the name of a body's free joint."""
        return self._free[body]

    def anchors(self, body: str | None) -> Iterator[tuple[str, Pose]]:
        """Yield the sites on a body (None: the world) that loops close at."""
        yield from self._anchors.get(body, [])

    def equalities(self, closure: Closure) -> list[tuple[str, str, str]]:
        """Return for each pair of anchors the equality's name and its two sites."""
        return self._closures[closure.name]

    def _closure(self, closure: Closure, sites: Numbered, equalities: Numbered) -> None:
        made = self._closures.setdefault(closure.name, [])
        several = len(closure.anchors) > 1
        for index, pair in enumerate(closure.anchors):
            stem = f"{closure.name}_{index}"
            name = equalities.take(stem if several else closure.name)
            ends = [sites.take(f"{stem}_{side}") for side in "ab"]
            for body, site, at in zip(closure.bodies, ends, pair, strict=True):
                self._anchors.setdefault(body, []).append((site, at))
            made.append((name, ends[0], ends[1]))
