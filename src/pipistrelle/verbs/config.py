"""`pipistrelle config`: the settings as a file, and what such a file may hold."""

from typing import Annotated

from cyclopts import Parameter

from pipistrelle.verbs.options import MissionOptions, mission_config
from pipistrelle.verbs.streams import put


def show(*, mission: Annotated[MissionOptions | None, Parameter(name="*")] = None) -> None:
    """Print the settings as TOML, file, environment and flags applied."""
    import numpy as np

    from pipistrelle.acoustics.paths import callers_of
    from pipistrelle.arrays.sampling import sampling
    from pipistrelle.settings import to_toml

    config, _, _ = mission_config(mission or MissionOptions())
    callers = callers_of(config, np.zeros(2))[: 2 if config.callers is None else 1]
    sampling(config, callers)  # it refuses the rates and tones that `run` does
    put(to_toml(config), end="")


def schema() -> None:
    """Print the JSON schema of the settings, for editors that check TOML."""
    import json

    from pipistrelle.config import Config

    put(json.dumps(Config.model_json_schema(), indent=2))
