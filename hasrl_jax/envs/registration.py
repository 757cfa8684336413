"""Makes the tasks known to gymnasium without importing it.

Worker processes import this package and must not pay for gymnasium, and gymnasium no longer looks for plugins
itself. So the tasks are registered at once where gymnasium is loaded already, and otherwise when it is.
"""

import importlib.util
import sys
from collections.abc import Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType

ENVIRONMENTS = {"hasrl_jax/Cassie-v0": "cassie", "hasrl_jax/CartpoleHiddenVelocity-v0": "cartpole"}  # id -> task


def register() -> None:
    """Registers every environment with gymnasium; doing so again changes nothing."""
    import gymnasium

    for name, task in ENVIRONMENTS.items():
        if name not in gymnasium.registry:
            gymnasium.register(name, entry_point="hasrl_jax.envs.gymnasium_env:make", kwargs={"task": task})


def register_when_imported() -> None:
    """Registers now if gymnasium is loaded, or right after its first import."""
    if "gymnasium" in sys.modules:
        register()
    elif not any(isinstance(finder, _AfterGymnasium) for finder in sys.meta_path):
        sys.meta_path.insert(0, _AfterGymnasium())


class _AfterGymnasium(MetaPathFinder):
    """Lets the ordinary finders load gymnasium, then registers. Acts once."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if fullname != "gymnasium":
            return None
        sys.meta_path.remove(self)
        spec = importlib.util.find_spec(fullname)
        if spec is None or spec.loader is None:
            return spec
        load = spec.loader.exec_module

        def load_and_register(module: ModuleType) -> None:
            load(module)
            register()

        spec.loader.exec_module = load_and_register  # type: ignore[method-assign]
        return spec
