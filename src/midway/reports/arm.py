"""The figures of a report about the arm and its puck."""

from collections.abc import Sequence

from midway.envs import registry as environments
from midway.envs.push import GOAL_THRESHOLD
from midway.reports import curves, imagination, strips, tabletop
from midway.reports.album import Album
from midway.reports.runs import Group, RunData
from midway.reports.study import SEED
from midway.training import decoder as decoders
from midway.training import policy as policies
from midway.types import ConfigurationError


def _add_distances(album: Album, env: str, gathered: Sequence[Group]) -> None:
    """Draw the distances that the evaluations tell apart, such as hand and puck."""
    found = [curves.distances(group) for group in gathered]
    if not any(found):
        return
    names = " and ".join(next(filter(None, found)))
    album.add(
        f"{env}-distances",
        lambda: curves.draw_distances(gathered, GOAL_THRESHOLD),
        f"Distance to the goal: {names}",
        "Mean distance at the end of the evaluations' episodes with mean actions, each by itself; "
        "an episode succeeds where all are below the dotted line at once.",
        f"Distance of {names} to their goals over environment steps, by task.",
    )


def add(album: Album, env: str, gathered: Sequence[Group]) -> None:
    """Draw what the saved policies do with arm and puck, and what they imagine."""
    _add_distances(album, env, gathered)
    for group in gathered:
        for run in list(filter(lambda run: run.has_policy, group.runs))[:1]:
            try:
                _add_tabletop(album, env, group, run)
            except ConfigurationError as error:
                where = f"{group.label}, seed {run.config.seed}"
                album.missing.append(f"{where}: nothing is drawn of the policy: {error}")
    album.missing += [
        f"{group.label}, seed {run.config.seed}: no policy saved yet, so nothing is drawn of it"
        for group in gathered
        for run in group.runs
        if not run.has_policy
    ]


def _add_tabletop(album: Album, env: str, group: Group, run: RunData) -> None:
    """Draw the ways of hand and puck, and what the agent imagines as images.

    Raises:
        ConfigurationError: The policy is damaged or foreign.
    """
    policy = policies.load(run.folder, environments.make_vec(env).goal_spec)
    recordings = tabletop.episodes(policy, SEED)
    where = f"seed {run.config.seed}, step {run.policy_step:,}"
    reached = sum(recording.success for recording in recordings)
    album.add(
        f"{env}-{group.slug}-table",
        lambda: tabletop.draw(policy, recordings, group.label),
        f"{group.label} at the table",
        f"Ways of hand and puck with mean actions ({where}), seen as the camera sees them. An "
        "episode ends when both are within 5 cm of their goals. Subgoals, where they are states, "
        "are those at the start.",
        f"Plan of the table with {len(recordings)} episodes of {group.label}, {reached} of which "
        "reach the goal.",
    )
    if not decoders.has_encoder(policy):
        return
    decoder = strips.decoder_of(run.folder, policy)
    imagines = imagination.imagines(run.config.agent)
    title = f"What {group.label} imagines" if imagines else f"What {group.label}'s codes keep"
    album.add(
        f"{env}-{group.slug}-images",
        lambda: strips.draw(policy, decoder, group.label, SEED),
        title,
        f"Columns are starts with their goals ({where}). A decoder that was fitted on the side "
        "turns codes into images; the decoded state and goal show how much of an image the code "
        "and the decoder keep."
        + (
            " Between them: the mean of the subgoal policy and one draw from it, decoded."
            if imagines
            else ""
        ),
        f"Images of {env}: states, goals"
        + (" and imagined subgoals" if imagines else "")
        + f" of {group.label}, on random and on hard configurations.",
    )
