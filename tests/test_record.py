"""Records on their way to those who listen."""

from torchmask.record import Record, fan_out, label_stage


def test_fan_out_calls_all_in_order():
    calls = []
    both = fan_out(lambda r: calls.append(("a", r.step)), lambda r: calls.append(("b", r.step)))
    both(Record("fit", 5, 10, {"loss": 1.0}))
    assert calls == [("a", 5), ("b", 5)]


def test_a_label_tells_the_runs_of_one_algorithm_apart_and_changes_nothing_else():
    seen = []
    record = Record("design/cma", 3, 7, {"mse": 0.1}, {})
    for label in ("6_holes", "9_holes"):
        label_stage(seen.append, label)(record)
    assert [one.stage for one in seen] == ["design/cma/6_holes", "design/cma/9_holes"]
    assert {(one.step, one.n_steps, one.scalars["mse"]) for one in seen} == {(3, 7, 0.1)}
    assert record.stage == "design/cma"
