"""What users may say on the command line of an environment that is not midway's."""

import dataclasses
import json
from typing import TYPE_CHECKING, Annotated

import tyro

from midway.errors import ConfigurationError

if TYPE_CHECKING:
    from midway.envs.describing import Foreign, Settings
    from midway.envs.registry import Declaration
    from midway.types import JsonObject


@dataclasses.dataclass(frozen=True)
class About:
    """What is said of the environment.

    Attributes:
        success_distance: A goal is reached within this distance of it.
        success_function: MODULE:FUNCTION of achieved and desired goals that says so.
        max_episode_steps: Steps of an episode, in place of the registered limit.
        action_bound: Bounds of actions that have none.
        step_seconds: Seconds after which a step of its copies in other processes counts as hanging.
        env_kwargs: Arguments of the environment, as JSON.
        imports: Modules that register environments.
        maze: File of a maze of your own, for the environments point and ant; or umaze, medium.
    """

    success_distance: float | None = None
    success_function: str | None = None
    max_episode_steps: int | None = None
    action_bound: float | None = None
    step_seconds: float = 600.0
    env_kwargs: str = "{}"
    imports: Annotated[tuple[str, ...], tyro.conf.arg(name="import")] = ()
    maze: str | None = None

    def env(self, name: str) -> "str | Foreign | Declaration":
        """Return the environment of this name, with what is said of it; the name if nothing is.

        Raises:
            ConfigurationError: It cannot be used.
        """
        if self == NOTHING:
            return name
        from midway.envs import describing, layouts
        from midway.envs.registry import ENVIRONMENTS, own_maze

        if self.maze is not None and self == About(maze=self.maze):
            return own_maze(name, layouts.read(self.maze))
        if name in ENVIRONMENTS:
            raise ConfigurationError(
                f"{' '.join(self.options())}: {name} is midway's own, of which nothing need be said"
            )
        return describing.admit(describing.describe(name, self.settings(), **self.source()))

    def settings(self) -> "Settings":
        """Return what is said of success, length and actions."""
        from midway.envs.describing import Settings

        return Settings(
            self.success_distance,
            self.success_function,
            self.max_episode_steps,
            self.action_bound,
            self.step_seconds,
        )

    def source(self) -> "JsonObject":
        """Return what is said of how the environment is made."""
        try:
            kwargs = json.loads(self.env_kwargs)
        except json.JSONDecodeError as error:
            raise ConfigurationError(f"--env-kwargs {self.env_kwargs}: {error}") from error
        if not isinstance(kwargs, dict):
            raise ConfigurationError(f"--env-kwargs {self.env_kwargs}: must be a JSON object")
        return {"kwargs": kwargs, "imports": self.imports}

    def options(self) -> list[str]:
        """Return the options that say the same on another command line."""
        given: list[str] = []
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if value != field.default:
                name = "import" if field.name == "imports" else field.name.replace("_", "-")
                values = value if isinstance(value, tuple) else (value,)
                given += [f"--{name}", *map(str, values)]
        return given


AboutEnv = Annotated[About, tyro.conf.OmitArgPrefixes]

NOTHING = About()
"""Nothing is said."""
