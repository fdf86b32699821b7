"""``consat split``, ``consat agent`` and ``consat launch``: parse the arguments and print the results."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from consat.cli.completion import agents, protocols
from consat.cli.options import (
    Burst,
    Listing,
    OneOf,
    estimates_option,
    force_option,
    full_option,
    json_option,
    out_option,
    scenario_argument,
    sends_option,
    set_option,
    words,
)
from consat.cli.terminal import DONE, located, tell
from consat.errors import counted
from consat.network.deploy.environment import prepare_own

if TYPE_CHECKING:
    from consat.network.node.part import Part

protocol_option = click.option(
    "--protocol",
    metavar="KIND",
    shell_complete=protocols,
    cls=Listing,
    listed=words("consat.protocols", "ROUNDS"),
    help="For --mode lockstep: one of {}, by default interior-point; else as the mode is called.",
)
port_option = click.option("--port", type=click.IntRange(1, 65535), default=7447, show_default=True, help="Of the first agent.")
mode_option = click.option(
    "--mode",
    type=OneOf(words("consat.network.node.modes", "Mode")),
    help="How they talk; admm if that is the protocol of the scenario, else interior-point.",
)
rate_option = click.option("--rate", type=click.FloatRange(min=0, min_open=True), metavar="HZ", help="Turns a second.")
speed_option = click.option("--speed", type=click.FloatRange(min=0, min_open=True), help="The most that a body moves, length/s.")
pace_option = click.option(
    "--pace", type=click.FloatRange(min=0, min_open=True), default=1.0, help="For --mode link: seconds of the protocol in a real one."
)
loss_option = click.option(
    "--loss", type=click.FloatRange(0, 1, max_open=True), default=0.0, help="Probability that a message is dropped where it arrives."
)
until_option = click.option("--until", type=click.FloatRange(min=0, min_open=True), metavar="SECONDS", help="When to stop.")
rounds_option = click.option("--rounds", type=click.IntRange(min=1), help="After how many turns to stop.")
epoch_option = click.option(
    "--epoch", type=float, metavar="UNIX-SECONDS", help="When t = 0 is, for constraints that move; to all agents the same."
)
keys_option = click.option(
    "--keys", type=click.Path(path_type=Path, file_okay=False), metavar="DIR", help="Of consat keys; if not given, `keys` beside FILE."
)


class _Delay(click.ParamType[tuple[float, float]]):
    """Type of an option: a delay ``S`` or a range of delays ``A,B``, s."""

    name = "S | A,B"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[float, float]:
        if isinstance(value, tuple):
            return value[0], value[1]
        try:
            ends = [float(part) for part in str(value).split(",")]
        except ValueError:
            ends = []
        if len(ends) not in (1, 2) or not 0 <= ends[0] <= ends[-1] < math.inf:
            self.fail(f"it is {value!r}, but must be a time in s, such as 0.1, or two, such as 0.05,0.2", param, ctx)
        return ends[0], ends[-1]


class _Position(click.ParamType[tuple[float, ...]]):
    """Type of an option: numbers separated by commas."""

    name = "X,Y"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[float, ...]:
        if isinstance(value, tuple):
            return value
        try:
            numbers = tuple(float(part) for part in str(value).split(","))
        except ValueError:
            numbers = (math.nan,)
        if not all(map(math.isfinite, numbers)):
            self.fail(f"it is {value!r}, but must be numbers such as 0.5,-1", param, ctx)
        return numbers


burst_option = click.option(
    "--burst", type=Burst(), help="What arrives turns bad with probability P a message, good again with Q; bad is lost."
)
delay_option = click.option("--delay", type=_Delay(), default=(0.0, 0.0), help="How long to hold messages back where they arrive, s.")


@click.command()
@scenario_argument
@set_option
@click.option("--out", required=True, type=click.Path(file_okay=False, path_type=Path), metavar="DIR", help="Where to.")
@click.option("--address", "addresses", multiple=True, metavar="ID=ADDRESS", help="Where an agent listens, e.g. a2=tcp/192.168.0.7:7447.")
@port_option
@click.option("--absent", multiple=True, metavar="ID", help="An agent that joins later; repeat it.")
@click.option("--run", metavar="NAME", help="Of the run on the network; agents of other runs are not heard.")
@protocol_option
@estimates_option
@click.option("--seed", type=click.IntRange(min=0), help="Of starts and first estimates; overrides start.seed.")
@epoch_option
def split(
    *, scenario: str, overrides: tuple[str, ...], out: Path,
    addresses: tuple[str, ...], port: int, absent: tuple[str, ...], run: str | None,
    protocol: str | None, estimates: str | None, seed: int | None, epoch: float | None,
) -> None:  # fmt: skip
    """Write one private file for each agent.

    It holds the agent's own constraints, its neighbours' names and addresses, and nothing of the others.
    """
    prepare_own(exact=False)
    from consat.network.names import spelled
    from consat.network.node.part import split as split_scenario
    from consat.network.node.part import write_part
    from consat.scenario import load

    loaded = _with(load(scenario, overrides), protocol, estimates, seed)
    pairs = [address.partition("=") for address in addresses]
    if bad := [agent for agent, equals, _ in pairs if not equals]:
        raise click.UsageError(f"--address {bad[0]!r} must be ID=ADDRESS, such as a2=tcp/192.168.0.7:7447")
    with located(loaded):
        parts = split_scenario(loaded, run=run, addresses={agent: to for agent, _, to in pairs}, port=port, absent=absent, epoch=epoch)
        texts = {agent: write_part(part) for agent, part in parts.items()}
    out.mkdir(parents=True, exist_ok=True)
    for agent, text in texts.items():
        target = out / f"{spelled(agent)}.yaml"
        target.touch(mode=0o600)
        target.write_text(text, encoding="utf-8")
        click.echo(f"{target}: consat agent {target} --id {agent}", err=True)


@click.command()
@scenario_argument
@click.option("--id", "agent", required=True, metavar="ID", shell_complete=agents, help="Which agent.")
@set_option
@mode_option
@rate_option
@pace_option
@sends_option
@speed_option
@click.option("--sensor", type=click.Choice(["simulated", "stdin"]), default="simulated", show_default=True, help="Whence positions come.")
@click.option(
    "--sensor-timeout", type=click.FloatRange(min=0, min_open=True), default=0.5, show_default=True, metavar="SECONDS",
    help="Without a measurement for so long, command to stand.",
)  # fmt: skip
@click.option("--robot", type=click.Choice(["point", "unicycle"]), help="For --sensor stdin: what is commanded; by default the scenario's.")
@click.option("--position", type=_Position(), help="Where a simulated body is, e.g. 0.5,-1; the scenario's start if not given.")
@rounds_option
@until_option
@click.option("--stop", type=click.Choice(["satisfied", "never"]), default="never", show_default=True, help="When to end earlier.")
@click.option("--memory", type=click.Path(dir_okay=False, path_type=Path), help="For --mode lockstep: keep the state in this file.")
@click.option("--give-up", type=click.FloatRange(min=0, min_open=True), metavar="SECONDS", help="Who is silent so long has left for good.")
@click.option("--report", type=click.FloatRange(min=0), default=0.1, show_default=True, metavar="SECONDS", help="Between two reports.")
@loss_option
@burst_option
@delay_option
@click.option("--seed", type=click.IntRange(min=0), default=0, help="Of the faults: loss, bursts, delay.")
@keys_option
@click.option("--attached", is_flag=True, help="Read orders from stdin, and stop when it ends.")
@click.option("--standby", is_flag=True, help="Wait for the order to join, on stdin.")
@epoch_option
@port_option
def agent(
    *, scenario: str, agent: str, overrides: tuple[str, ...], port: int, mode: Any, rate: float | None, pace: float,
    rounds: int | None, memory: Path | None, give_up: float | None, report: float, keys: Path | None, sends: Any, **options: Any,
) -> int:  # fmt: skip
    """Run one agent, as on its own robot.

    FILE is its private file (consat split), or a scenario, of which it takes its own part. Events are JSON lines on stdout.
    """
    prepare_own(exact=mode == "lockstep")
    from consat.faults import Faults
    from consat.network.deploy.process import ProcessOptions, run_agent
    from consat.network.node.modes import NodeSettings, mode_for
    from consat.network.node.part import is_part, load_text, read_part

    speed = options.pop("speed")
    part = _part(scenario, agent, overrides, port, mode)
    node = NodeSettings(
        mode or mode_for(part.settings.protocol.kind), rate, pace, rounds, memory, math.inf if give_up is None else give_up, report, sends
    )
    if options["robot"] is not None and options["sensor"] != "stdin":
        raise click.UsageError("--robot is commanded by what --sensor stdin measures; a simulated body is a point")
    position = options["position"]
    if position is not None and len(position) != part.team.dimension:
        raise click.UsageError(f"--position has {counted(len(position), 'number')}, but must have {part.team.dimension}")
    file = Path(scenario)
    again = (lambda: read_part(load_text(file), scenario)) if file.is_file() and is_part(load_text(file), scenario) else None
    faults = Faults(options.pop("loss"), seed=options.pop("seed"), burst=options.pop("burst"), delay=options.pop("delay"))
    options |= {"faults": faults, "speed": math.inf if speed is None else speed, "keys": _keys(keys, scenario, [agent])}
    run_agent(part, node, ProcessOptions(**options), again)
    return DONE


@click.command()
@scenario_argument
@set_option
@mode_option
@protocol_option
@estimates_option
@click.option("--seed", type=click.IntRange(min=0), help="Of starts, loss and delay; overrides start.seed.")
@rate_option
@pace_option
@sends_option
@speed_option
@loss_option
@burst_option
@delay_option
@rounds_option
@until_option
@click.option("--stop", type=OneOf(words("consat.settings", "Stop")), help="When to end; by itself if nothing is said.")
@click.option(
    "--commands", type=click.Path(exists=True, dir_okay=False, path_type=Path), metavar="FILE", help="Timed changes: YAML or JSON lines."
)
@keys_option
@out_option
@force_option
@full_option
@click.option("--quiet", is_flag=True, help="No table and no summary.")
@json_option
def launch(
    *, scenario: str, overrides: tuple[str, ...], protocol: str | None, estimates: str | None, seed: int | None, keys: Path | None,
    out: Path | None, force: bool, full: bool, quiet: bool, as_json: bool, **plan: Any,
) -> int:  # fmt: skip
    """Run every agent of a team as a process on this machine.

    They are watched until they have converged, and started again if they crash; then a result is gathered.
    """
    prepare_own(exact=False)
    from consat.engine.files import claim
    from consat.faults import Faults
    from consat.network.deploy.launch import Plan
    from consat.network.deploy.launch import launch as launch_team
    from consat.network.node.modes import mode_for
    from consat.results.result import RESULT
    from consat.runs.preparation import default_protocol
    from consat.scenario import load

    loaded = _with(load(scenario, overrides), protocol, estimates, seed)
    asked = loaded.settings.protocol
    plan["faults"] = Faults(plan.pop("loss"), burst=plan.pop("burst"), delay=plan.pop("delay"))
    plan["mode"] = plan["mode"] or mode_for(asked.kind or default_protocol(loaded.team, asked.estimates))
    if out is not None:
        claim(out, loaded.name, force=force)
    with located(loaded):
        result = launch_team(loaded, Plan(**plan, keys=_keys(keys, scenario, loaded.team.ids)), quiet=quiet or as_json, full=full)
    if out is not None:
        result.summary["result"] = str(out / RESULT)
        result.save(out / RESULT)
        result.plot(out)
    return tell(result, quiet=quiet, as_json=as_json)


def _with(scenario: Any, protocol: str | None, estimates: str | None, seed: int | None) -> Any:
    """Copy of the scenario with the settings of the command line; None leaves a setting unchanged."""
    import dataclasses

    asked = scenario.settings
    changes = {key: value for key, value in (("kind", protocol), ("estimates", estimates)) if value is not None}
    settings = asked.model_copy(
        update={
            "protocol": asked.protocol.model_copy(update=changes),
            "start": asked.start if seed is None else asked.start.model_copy(update={"seed": seed}),
        }
    )
    return dataclasses.replace(scenario, settings=settings)


def _part(file: str, agent: str, overrides: tuple[str, ...], port: int, mode: Any) -> Part:
    """The part of an agent: read from its private file, or split from a scenario for the protocol of the mode."""
    from consat.errors import InvalidSettings, closest
    from consat.network.node.modes import protocol_of
    from consat.network.node.part import is_part, load_text, read_part, split
    from consat.scenario import load

    path = Path(file)
    if path.is_file() and is_part(text := load_text(path), file):
        if overrides:
            raise click.UsageError("--set changes a scenario, but FILE is one agent's part; split the scenario again")
        part = read_part(text, file)
        if part.me != agent:
            raise InvalidSettings(f"{file} is the part of agent {part.me!r}, not of {agent!r}")
        return part
    loaded = load(file, overrides)
    if agent not in loaded.team.ids:
        raise InvalidSettings(f"there is no agent {agent!r}{closest(agent, loaded.team.ids)}")
    if mode not in (None, "lockstep"):
        loaded = _with(loaded, protocol_of(mode, loaded.settings.protocol.kind), None, None)
    with located(loaded):
        return split(loaded, port=port, only=agent)[agent]


def _keys(given: Path | None, file: str, agents: Any) -> Path | None:
    """Folder of the keys: the given one, or ``keys`` beside FILE if it exists; None without keys.

    Raises:
        NetworkError: the folder beside FILE has no keys for one of the agents.
    """
    from consat.errors import NetworkError
    from consat.network.names import CA, KEY, spelled

    if given is not None:
        return given
    beside = Path(file).parent / "keys"
    if not (Path(file).is_file() and (beside / CA).is_file()):
        return None
    own = len(agents) == 1 and (beside / KEY).is_file()  # a folder with the keys of this agent only
    if lacking := [repr(agent) for agent in agents if not own and not (beside / spelled(agent)).is_dir()]:
        raise NetworkError(
            f"there are keys in {beside}, but none of {', '.join(lacking)}; make them (consat keys … --out {beside}), or say --keys"
        )
    click.echo(f"links are protected by the keys in {beside}", err=True)
    return beside
