"""Gymnasium ids of the environments, apart from their code so that ``import midway`` is quick."""

import gymnasium

GYM_IDS = {
    f"{body}-{shape.lower()}": f"midway/{title}-{shape}-v0"
    for body, title in (("point", "PointMaze"), ("ant", "AntMaze"))
    for shape in ("U", "S", "Pi", "Omega")
} | {"push": "midway/Push-v0", "push-state": "midway/PushState-v0"}
"""Gymnasium id of each environment by the name that users type."""


def register_ids() -> None:
    """Register every environment with Gymnasium, single and vector."""
    for name, gym_id in GYM_IDS.items():
        gymnasium.register(
            id=gym_id,
            entry_point="midway.envs.single:SingleGoalEnv",
            vector_entry_point="midway.envs.registry:make_vec",
            kwargs={"name": name},
        )
