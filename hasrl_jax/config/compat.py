"""Reads configurations that earlier versions wrote."""

from typing import Any

from hasrl_jax.config import strict_yaml, tasks


def upgraded(values: Any) -> Any:
    """What an earlier version wrote, in today's form; anything else as it is.

    Until version 0.2 a configuration held the settings of every task, and a stage was a text, "STEPS FIELD=VALUE ...".
    """
    if not isinstance(values, dict):
        return values
    task = values.get("task", "cassie")
    # A task of one's own may have the settings of the one that it extends.
    others = set(tasks.BUILT_IN) - {task} if task in list(tasks.BUILT_IN) else set()
    values = {name: value for name, value in values.items() if name not in others}
    if isinstance(values.get("stages"), list):
        values["stages"] = [_stage(stage) for stage in values["stages"]]
    return values


def _stage(stage: Any) -> Any:
    if not isinstance(stage, str) or not stage:
        return stage
    begin, *settings = stage.split()
    pairs = (setting.partition("=") for setting in settings)
    return {"at_env_steps": int(float(begin)), "set": {field: strict_yaml.parse(value) for field, _, value in pairs}}
