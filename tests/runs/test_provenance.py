"""What a run was made with, and what is said where it goes on elsewhere."""

from midway.runs.provenance import changed_here, provenance


def test_nothing_is_said_where_all_is_as_before() -> None:
    assert changed_here(provenance()) == ""


def test_other_cores_and_releases_are_named_with_both_values() -> None:
    record = provenance()
    here = record["machine"]["cores"]
    elsewhere = {
        **record,
        "machine": {**record["machine"], "cores": here + 6},
        "versions": {**record["versions"], "jax": "0.9.0"},
    }
    said = changed_here(elsewhere)
    assert f"cores {here + 6} before, {here} here" in said
    assert "jax 0.9.0 before" in said
    assert "mujoco" not in said


def test_what_counts_is_where_it_went_on_last() -> None:
    record = provenance()
    other = {**record, "machine": {**record["machine"], "cores": 99}}
    assert changed_here({**other, "resumed": [record]}) == ""
    assert "cores 99 before" in changed_here({**record, "resumed": [record, other]})
