"""The picture of `bench mjx`: speed by number of environments, and where the time goes."""

from pathlib import Path

SPEEDS = {
    "physics_steps_per_second": "physics alone, physics steps/s",
    "env_steps_per_second": "collection, environment steps/s",
    "env_steps_per_second_training": "collection and learner, environment steps/s",
}
SHARES = {
    "physics_share": "physics",
    "policy_share": "policy, observations, rewards",
    "learner_share": "learner",
}


def plot(figures: dict, device: str, out: Path) -> None:
    """Draws the figures of `bench.mjx.measure` to a PNG.

    Args:
      figures: with at least one cell.
      device: where they were measured, for the title.
      out: the file.
    """
    from matplotlib.figure import Figure

    cells = figures["cells"]
    num_envs = [cell["num_envs"] for cell in cells]
    drawing = Figure(figsize=(11, 4.2), layout="constrained")
    speed, share = drawing.subplots(1, 2)
    for name, label in SPEEDS.items():
        speed.plot(num_envs, [cell[name] for cell in cells], "o-", label=label)
    speed.set_xscale("log", base=2)
    speed.set_yscale("log")
    speed.set(xlabel="environments", ylabel="steps per second")
    speed.grid(alpha=0.3, which="both")
    speed.legend(fontsize="small")
    bottom = [0.0] * len(cells)
    positions = range(len(cells))
    for name, label in SHARES.items():
        values = [cell[name] for cell in cells]
        share.bar(positions, values, bottom=bottom, label=label)
        bottom = [low + value for low, value in zip(bottom, values, strict=True)]
    share.set_xticks(positions, [str(number) for number in num_envs])
    share.set(xlabel="environments", ylabel="share of an iteration's time", ylim=(0, 1.15))
    share.legend(fontsize="small", loc="upper center", ncols=3)
    drawing.suptitle(f"{figures['task']} on MJX ({figures['impl']}), {figures['devices']} × {device}")
    drawing.savefig(out, format="png", dpi=110)
