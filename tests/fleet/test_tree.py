"""The tree of a site: it grows at its end, and gives the map that one merge of all sessions gives."""

import numpy as np
from mapping.site_days import Place, session

from objslam.core.geometry import inverse
from objslam.fleet.tree import LEAF, tree_of
from objslam.mapping.sites.merge import merge_sessions
from objslam.mapping.sites.session import Session, Visit


def test_sessions_at_the_end_change_only_the_way_to_the_root():
    for count in (1, 3, LEAF, 37, 100):
        names = [str(k) for k in range(count + 5)]
        old, new = ({n.key for level in tree_of(some) for n in level} for some in (names[:count], names))
        assert tree_of(names)[-1][0].sessions == tuple(names)
        assert len(new - old) <= 2 * (np.log2(len(names)) + 2)
    assert tree_of(["a", "b"])[-1][0].key != tree_of(["b", "a"])[-1][0].key


def merged(sessions, visits):
    """The largest island of a merge, with the visits of all sessions below it."""
    island = merge_sessions(sessions)[0]
    placed = zip(island.sessions, island.site_T_session, strict=True)
    below = tuple(
        Visit(one.session, one.session_T_site @ inverse(pose)) for number, pose in placed for one in visits[number]
    )
    return Session("site", island.objects, visits=lambda: below), island


def test_pairs_of_pairs_give_the_map_of_one_merge():
    place, days = Place(np.random.default_rng(1), count=24), []
    for day in range(8):
        if day in (3, 6):
            place.change(0.15, day)
        days.append(session(place, day)[0])
    once = merge_sessions(days)[0].objects
    nodes = []
    for k in range(0, 8, 2):
        group = days[k : k + 2]
        nodes.append(merged(group, [(Visit(one, np.eye(4)),) for one in group])[0])
    for _ in range(2):
        pairs = [nodes[k : k + 2] for k in range(0, len(nodes), 2)]
        nodes = [merged(pair, [one.visits() for one in pair])[0] if len(pair) == 2 else pair[0] for pair in pairs]
    tree = nodes[0].objects
    apart = np.linalg.norm(tree.positions[:, None] - once.positions, axis=2)
    near = apart.argmin(axis=1)
    same = apart.min(axis=1) < 0.2
    assert same.mean() >= 0.95
    assert abs(len(tree) - len(once)) <= 1
    assert np.sqrt(np.mean(apart.min(axis=1)[same] ** 2)) < 0.01
    states = [tree[i].life.state == once[int(near[i])].life.state for i in np.flatnonzero(same)]
    assert np.mean(states) >= 0.95
    seen = [(tree[i].life.sessions_seen, once[int(near[i])].life.sessions_seen) for i in np.flatnonzero(same)]
    assert np.mean([abs(a - b) <= 1 for a, b in seen]) >= 0.95
    gone = [np.linalg.norm(once.positions - o.position, axis=1).min() for o in tree.gone]
    assert len(tree.gone) >= len(once.gone) - 1
    assert all(distance > 0.2 for distance in gone)
