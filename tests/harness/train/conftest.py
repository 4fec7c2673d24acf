"""A clock that tests set, and the training sets of the scene."""

import pytest

from chronoscene.harness.plan.parts import make_parts
from chronoscene.images.store import ImageStore


class FakeClock:
    """Stands still but for what the test says."""

    def __init__(self):
        self.seconds = 100.0

    def __call__(self):
        return self.seconds

    def takes(self, seconds, function):
        """The function, which takes this long."""

        def timed(*args, **kwargs):
            self.seconds += seconds
            return function(*args, **kwargs)

        return timed

    def waits(self, seconds, store, function):
        """The function, which waits this long for photos of a store."""

        def waiting(*args, **kwargs):
            store.waited += seconds
            return function(*args, **kwargs)

        return self.takes(seconds, waiting)


@pytest.fixture
def clock():
    return FakeClock()


@pytest.fixture
def part(make_scene):
    """The part of strategy ``joint``."""
    scene = make_scene()
    return make_parts(scene, ImageStore(scene), "joint")[0]
