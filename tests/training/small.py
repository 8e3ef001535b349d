"""Settings of a run from images that is over in seconds."""

SMALL = {
    "hidden": (8, 8),
    "batch_size": 8,
    "num_envs": 2,
    "random_steps": 20,
    "updates_per_step": 0.5,
    "replay_capacity": 500,
    "evaluate_every": 60,
    "evaluation_episodes": 1,
    "log_every": 10,
    "checkpoint_every": 30,
    "steps": 60,
}
