"""`hasrl export`: writes a policy to one file, as NumPy arrays, ONNX or StableHLO, and the model of its robot."""

import sys
from pathlib import Path

from hasrl_jax.cli import parsing as cli
from hasrl_jax.cli.options import OneLineParser, require_writable
from hasrl_jax.config.convert import from_dict
from hasrl_jax.deploy import export as formats
from hasrl_jax.deploy import model_file, verify
from hasrl_jax.deploy.metadata import training_digest
from hasrl_jax.envs.registry import make_task
from hasrl_jax.errors import ConfigError
from hasrl_jax.policy import loading as policies


def export(arguments: list[str]) -> None:
    """The command: the newest whole checkpoint of a run, or a policy file, in another format."""
    parser = OneLineParser(
        prog="python -m hasrl_jax.export",
        description="Write a policy to one file, see docs/deploy.md. Physics and cassie settings that differ from the "
        "training's, and that whoever plays the file then starts from, can be given: --cassie.randomize.enabled False",
        allow_abbrev=False,
    )
    parser.add_argument("--run-dir", type=Path, help="a run directory; its newest checkpoint is taken")
    parser.add_argument("--policy", help=f"a policy file (.npz), or one of {', '.join(policies.RELEASED)}")
    parser.add_argument("--format", choices=tuple(formats.SUFFIXES), default="npz", help="default npz")
    parser.add_argument("--out", type=Path, help=f"the file to write: {', '.join(formats.SUFFIXES.values())}")
    parser.add_argument("--model", type=Path, help="also write the robot's MJCF here, .xml")
    parser.add_argument(
        "--physics", choices=("paper", "training"), default="paper", help="of --model: 2 kHz (Cassie), or as trained"
    )
    known, rest = parser.parse_known_args(arguments)
    if known.run_dir is None and known.policy is None:
        raise ConfigError("--run-dir: missing; expected a run directory, or --policy with a policy file")
    if known.out is None and known.model is None:
        raise ConfigError("--out: missing; expected the file to write, or --model with one for the robot")
    if known.out:
        require_writable("--out", known.out, formats.SUFFIXES[known.format])
    if known.model:
        require_writable("--model", known.model, ".xml")
    trained, parameters = policies.load_policy_parameters(known.run_dir, known.policy)
    digest = policies.training_digest_of(known.policy) or training_digest(trained, parameters)
    # Where it was trained is nobody's business, and its curriculum is over.
    trained = from_dict({"run_dir": "", "stages": []}, trained)
    if known.out:
        config = cli.override_for_policy(trained, rest, "export")
        found = formats.write(known.out, known.format, config, parameters, digest)
        print(
            f"{known.out}: {known.out.stat().st_size / 1000:.0f} kB; {verify.STEPS} steps beside the policy: "
            f"largest difference of an action {found.difference:.1e}, {1000 * found.inference_s:.3f} ms per step"
        )
    if known.model:
        config = cli.to_play(trained, known.physics, rest, "export")
        model_file.write(known.model, make_task(config), config.physics)
        print(f"{known.model}: {1 / config.physics.timestep_s:g} Hz physics")


def main(argv: list[str] | None = None) -> int:
    """The command line; returns the exit status."""
    cli.log_to_terminal()
    return cli.run(lambda: export(sys.argv[1:] if argv is None else argv))


if __name__ == "__main__":
    sys.exit(main())
