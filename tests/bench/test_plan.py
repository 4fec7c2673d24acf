"""Plans: whose overrides they are, and what a run differs in."""

from chronoscene.bench.plan import BenchSettings, first_difference, split_overrides
from chronoscene.methods import load_spec


def test_differences_are_named():
    old = {"config": {"a": 1, "b": {"c": 2}}, "seed": 0}
    new = {"config": {"a": 1, "b": {"c": 3}}, "seed": 0}
    assert first_difference(old, new) == ("c 2", "c 3")


def test_overrides_with_a_prefix_are_for_one_method(tmp_path):
    settings = BenchSettings((), (), tmp_path, overrides={"blind.rate": "1", "rate": "2"})
    specs = [load_spec("toy_methods:MEAN"), load_spec("toy_methods:BLIND")]
    assert split_overrides(settings, specs) == {"mean": {"rate": "2"}, "blind": {"rate": "1"}}
