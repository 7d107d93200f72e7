"""A task is what it says, in whatever order it says it."""

from torchmask.design.sweep import run_tasks


def difference(task):
    return {"first": task["a"] - task["b"], "second": task["b"] - task["a"]}


def test_a_task_with_its_keys_in_another_order_is_not_computed_again(tmp_path):
    one, other = {"a": 3.0, "b": 1.0}, {"b": 1.0, "a": 3.0}
    found = run_tasks(difference, [one], tmp_path, stage="difference", n_workers=1)
    assert found == [{"first": 2.0, "second": -2.0}]

    def never(task):
        raise AssertionError("computed again")

    assert run_tasks(never, [other, one], tmp_path, stage="difference", n_workers=1) == 2 * found
    assert len(list(tmp_path.glob("*.json"))) == 1
