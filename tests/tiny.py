"""Settings of runs that are over in seconds; one set, so that tests share compiled programs."""

TINY: dict[str, object] = {
    "hidden": (8,),
    "batch_size": 8,
    "num_envs": 4,
    "random_steps": 40,
    "replay_capacity": 2_000,
    "evaluate_every": 60,
    "evaluation_episodes": 2,
    "log_every": 20,
    "checkpoint_every": 40,
}
