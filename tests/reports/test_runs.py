"""Reading run folders and grouping them."""

import dataclasses

import numpy as np
import pytest

from midway import api
from midway.agents import leap
from midway.errors import ConfigurationError
from midway.reports import report
from midway.reports.cache import Study
from midway.reports.recordings import record
from midway.reports.runs import groups, read, seeds_of
from midway.tables import read as read_table


def with_config(run, **changes):
    return dataclasses.replace(run, config=dataclasses.replace(run.config, **changes))


def test_a_run_is_read(ris_run):
    run = read(ris_run)
    assert run.finished
    assert run.steps == 1_200
    assert run.has_policy
    assert run.name == "point-u-ris-seed0"
    assert run.record["versions"]["midway"]
    hard = run.evaluated("hard", "mean")
    assert hard["step"].tolist() == [0, 400, 800, 1200]


def test_a_line_that_is_being_written_is_left_out(tmp_path):
    file = tmp_path / "metrics.csv"
    file.write_text("step,loss\n1,0.5\n2,\n3")
    table = read_table(file)
    assert table["step"].tolist() == [1, 2]
    assert table["loss"][0] == 0.5
    assert table["loss"][1] != table["loss"][1]


@pytest.mark.parametrize("text", ["", "step,loss\n", "step,loss\n1"])
def test_a_table_without_rows_has_no_columns(tmp_path, text):
    file = tmp_path / "metrics.csv"
    file.write_text(text)
    assert read_table(file) == {}
    assert read_table(tmp_path / "missing.csv") == {}


def test_plans_have_as_many_subgoals_as_are_asked_for(leap_run, tmp_path):
    two, three = ({"num_subgoals": "2"}, {"num_subgoals": 3})
    seen = [Study(read(leap_run, changes=changes), tmp_path) for changes in ({}, two, three)]
    plans = [study.plan() for study in seen]
    assert [len(plan["x"]) for plan in plans] == [3, 2, 3]
    # The tables of one number are not taken for those of another, however it is written.
    assert len(list(tmp_path.glob("*-plan.csv"))) == 2
    assert seen[1].where.endswith(", num_subgoals 2")
    assert seen[1].policy.config.hyperparameters.num_subgoals == 2
    np.testing.assert_array_equal(plans[0]["x"], plans[2]["x"])


def test_an_episode_knows_which_subgoal_each_action_aimed_at(leap_run):
    policy = api.load(leap_run)
    (episode,) = record(policy, {"hard": 1}, seed=0)
    assert episode.plans is not None
    assert episode.plans.subgoals.shape == (episode.length, 3, 4)
    steps = leap.segment_steps(policy.config.hyperparameters, policy.spec)
    assert 3 * steps < episode.length
    # In the last segment, which aims at the goal, it is the last one.
    expected = np.minimum(np.arange(episode.length) // steps, 2)
    np.testing.assert_array_equal(episode.plans.due, expected)


@pytest.mark.parametrize(
    ("run", "name", "text"),
    [
        ("ris_run", "num_subgoals", "'num_subgoals' of ris may not change after training: it has"),
        ("sac_run", "discount", "'discount' of sac may not change after training: it has none"),
        ("leap_run", "latent_size", "'latent_size' of leap .* use one of num_subgoals, adapt_"),
        ("leap_run", "num_subgoals", "num_subgoals 0: must be at least 1"),
    ],
)
def test_other_settings_do_not_change_after_training(run, name, text, request):
    path = request.getfixturevalue(run)
    for use in (read, api.load):
        with pytest.raises(ConfigurationError, match=text):
            use(path, changes={name: 0})


def test_seeds_are_one_group_and_settings_another(ris_run, sac_run):
    run = read(ris_run)
    seeds = [with_config(run, seed=seed) for seed in (1, 0)]
    settings = dataclasses.replace(run.config.hyperparameters, kl_weight=0.5)
    other = with_config(run, hyperparameters=settings)
    found = groups([read(sac_run), *seeds, other])
    assert [group.label for group in found] == ["RIS, kl_weight 0.1", "RIS, kl_weight 0.5", "SAC"]
    assert [group.slug for group in found] == ["ris", "ris-2", "sac"]
    assert [r.config.seed for r in found[0].runs] == [0, 1]
    assert len({group.colour for group in found}) == 3
    assert len({group.marker for group in found}) == 3


def test_legends_count_the_seeds_of_every_environment(ris_run):
    run = read(ris_run)
    (one,) = groups([run])
    (three,) = groups([with_config(run, seed=seed) for seed in range(3)])
    assert [seeds_of([one]), seeds_of([three, three])] == ["1 seed", "3 seeds"]
    assert seeds_of([three, one]) == "1 to 3 seeds"


def test_runs_of_different_length_are_one_group(ris_run):
    run = read(ris_run)
    longer = dataclasses.replace(run.config.train, steps=5_000, evaluate_every=7)
    found = groups([run, with_config(run, seed=1, train=longer)])
    assert [group.label for group in found] == ["RIS"]
    assert not found[0].runs[1].finished


def test_a_foreign_folder_is_one_line(tmp_path, ris_run):
    (tmp_path / "other").mkdir()
    for path in (tmp_path / "other", tmp_path / "missing"):
        with pytest.raises(ConfigurationError, match=path.name) as error:
            report([ris_run, path], tmp_path / "out")
        assert "\n" not in str(error.value)
    assert not (tmp_path / "out").exists()


def test_no_folder_and_an_unwritable_place_are_errors(tmp_path, ris_run):
    with pytest.raises(ConfigurationError, match="no run folder"):
        report([])
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigurationError, match="cannot write the report"):
        report([ris_run], tmp_path / "file" / "out")
