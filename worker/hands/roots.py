"""Where a hand begins: below the arm that it sits on, and which parts of a whole robot are hands."""

from __future__ import annotations

from collections import deque

import numpy as np

from service.model.errors import HandError
from worker.hands.options import HandOptions
from worker.hands.robot import Joint, Robot

#: No finger reaches farther than this from where the fingers of its hand part [m]; legs and arms do.
MAX_FINGER_M = 0.35
#: What reaches farther than this from its first joint is no hand by itself [m].
MAX_HAND_M = 0.5


def pick_root(robot: Robot, options: HandOptions) -> str:
    """The chosen root; else the robot's, moved down past dropped links, and past the joints of an arm or a wrist.

    Raises:
        HandError: it is a whole robot, or an arm without a hand; the message names the hands that it has.
    """
    if options.root:
        return options.root
    root, drop = robot.root, set(options.drop)
    while root in drop:
        children = [j.child for j in robot.joints.values() if j.parent == root]
        if len(children) != 1:
            raise HandError(f"link {root!r} is dropped and has {len(children)} children; name the new root link")
        root = children[0]
    tree = _Moving(robot, options)
    root = _below_arm(tree, root, options)
    if options.palm or tree.reach(root) <= MAX_HAND_M:
        return root
    hands = hand_links(tree, root)
    if len(hands) == 1:
        return hands[0]
    if hands:
        named = ", or ".join(f"--root {link}" for link in hands[:6])
        raise HandError.with_fixes(
            f"this is a robot with {len(hands)} hands", f"name its hand: {named}", *({"root": one} for one in hands[:6])
        )
    if stiff := tree.stiff_digits():
        raise HandError.with_fixes(
            f"no part of this robot branches into fingers that move: {', '.join(stiff[:4])} are fixed joints",
            "give a description in which its fingers move, or name another part: --root LINK",
            {"root": None},
        )
    raise HandError.with_fixes(
        "no part of this robot branches into fingers", "if it has a hand, name it: --root LINK", {"root": None}
    )


def hand_links(tree: _Moving, root: str) -> list[str]:
    """Links, from the root down, at which a hand begins: where two fingers or more part, none of them long."""
    found: list[str] = []
    queue = deque([root])
    while queue:
        link = queue.popleft()
        fingers = tree.onward(link)
        if len(fingers) > 1 and tree.reach(link) <= MAX_FINGER_M and tree.touches(link):
            found.append(link)
        else:
            queue.extend(joint.child for joint in fingers)
    return found


class _Moving:
    """The joints of a robot behind which something moves."""

    def __init__(self, robot: Robot, options: HandOptions) -> None:
        self.robot, self.options = robot, options
        self._children: dict[str, list[Joint]] = {}
        for joint in robot.joints.values():
            if joint.child not in options.drop:
                self._children.setdefault(joint.parent, []).append(joint)
        self._moves: dict[str, bool] = {}
        self._reach: dict[str, float] = {}
        for link in self._deepest_first(robot.root):
            children = self._children.get(link, [])
            self._moves[link] = any(self.free(joint) or self._moves[joint.child] for joint in children)
            ways = [self._way(joint) + self._reach[joint.child] for joint in children if self.free_below(joint)]
            self._reach[link] = max(ways, default=0.0)

    def _deepest_first(self, root: str) -> list[str]:
        order, stack = [], [root]
        while stack:
            order.append(link := stack.pop())
            stack += [joint.child for joint in self._children.get(link, [])]
        return order[::-1]

    def free(self, joint: Joint) -> bool:
        """Whether the joint itself moves."""
        return joint.type != "fixed" and joint.name not in self.options.fix

    def free_below(self, joint: Joint) -> bool:
        """Whether the joint, or one behind it, moves."""
        return self.free(joint) or self._moves[joint.child]

    def onward(self, link: str) -> list[Joint]:
        """Joints of a link behind which something moves."""
        return [joint for joint in self._children.get(link, []) if self.free_below(joint)]

    def reach(self, link: str) -> float:
        """Longest way from a link along its joints to the last one that moves [m]."""
        return self._reach[link]

    def touches(self, link: str) -> bool:
        """Whether two of the branches below a link have collision shapes."""
        return sum(self._has_shape(joint.child) for joint in self.onward(link)) > 1

    def stiff_digits(self) -> list[str]:
        """Fixed joints of the first link, behind a moving joint and with none behind it, at which shapes part."""
        for joint in self.robot.joints.values():
            ends = deque([joint.child] if self.free(joint) and not self._moves[joint.child] else [])
            while ends:
                digits = [other for other in self._children.get(ends.popleft(), []) if self._has_shape(other.child)]
                if len(digits) > 1:
                    return [digit.name for digit in digits]
                ends.extend(digit.child for digit in digits)
        return []

    def _has_shape(self, link: str) -> bool:
        if self.robot.links[link].shapes:
            return True
        return any(self._has_shape(joint.child) for joint in self._children.get(link, []))

    @staticmethod
    def _way(joint: Joint) -> float:
        return float(np.linalg.norm(joint.origin[:3]))


def _below_arm(tree: _Moving, root: str, options: HandOptions) -> str:
    """Where a hand on an arm begins: behind the last moving joint before the fingers part; else the root itself."""
    start, at = root, root
    palm = options.palm.link if options.palm else None
    while at != palm:
        onward = tree.onward(at)
        if len(onward) != 1:
            # A tree that never parts is a single finger: nothing above it is an arm.
            return start if onward else root
        (joint,) = onward
        at = joint.child
        if tree.free(joint):
            start = at
    return start
