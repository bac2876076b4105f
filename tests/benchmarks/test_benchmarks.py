"""Each benchmark runs at a tiny size and writes the rows that it promises."""

from benchmarks import common


def test_calls_take_turns_in_every_round(monkeypatch):
    monkeypatch.setattr(common, "BURST", 0.0)
    order = []
    found = common.medians({name: lambda name=name: order.append(name) for name in "ab"}, rounds=3)
    assert list(found) == ["a", "b"] and all(value >= 0 for value in found.values())
    assert "".join(order[-18:]) == "aaabbb" * 3  # each turn: two calls to warm up, one that is timed
