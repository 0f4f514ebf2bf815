"""Union-find: disjoint sets as trees, each named by its root, compiled (docs/adr/0018)."""

from __future__ import annotations

from labapp.core.compiled import inner
from labapp.core.values import IntArray


@inner
def root(parent: IntArray, member: int) -> int:
    """The root of a member's tree, which becomes less deep; ``parent`` has the shape (n,)."""
    while parent[member] != member:
        parent[member] = parent[parent[member]]
        member = parent[member]
    return member
