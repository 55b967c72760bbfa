"""A full garbage collection comes between frames, and not while one is being mapped."""

import gc

import pytest

from objslam.live.session.low_latency import collect_early


def test_a_full_collection_comes_early_if_it_is_soon_due(monkeypatch):
    done: list[int] = []
    monkeypatch.setattr(gc, "collect", lambda: done.append(1))
    monkeypatch.setattr(gc, "get_freeze_count", lambda: 1)
    monkeypatch.setattr(gc, "get_threshold", lambda: (700, 10, 10))
    for smaller, expected in ((8, 0), (9, 1), (10, 2)):
        monkeypatch.setattr(gc, "get_count", lambda smaller=smaller: (0, 0, smaller))
        collect_early()
        assert len(done) == expected


def test_exempt_objects_are_not_counted_while_no_collection_is_due(monkeypatch):
    """Python counts them one by one. In a large process that took most of the time of a session."""
    monkeypatch.setattr(gc, "get_freeze_count", lambda: pytest.fail("counted"))
    monkeypatch.setattr(gc, "get_threshold", lambda: (700, 10, 10))
    monkeypatch.setattr(gc, "get_count", lambda: (0, 0, 8))
    collect_early()


def test_a_program_that_was_not_configured_keeps_its_collections(monkeypatch):
    monkeypatch.setattr(gc, "get_freeze_count", lambda: 0)
    monkeypatch.setattr(gc, "get_count", lambda: (0, 0, 10))
    monkeypatch.setattr(gc, "collect", lambda: pytest.fail("collected"))
    collect_early()
