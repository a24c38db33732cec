"""Fixtures of the tests of chemistry."""

from __future__ import annotations

import pytest

from systems.chemistry.validity import Geometry, geometry_from_scene
from systems.scene import Scene


@pytest.fixture(scope="module")
def geometry(alanine_dipeptide: Scene) -> Geometry:
    """The rules of alanine dipeptide, of its scene alone."""
    return geometry_from_scene(alanine_dipeptide)
