"""The command line: parses arguments and prints results. Only results and JSON go to stdout; progress, logs and errors go to stderr."""

from __future__ import annotations

import gc
import json
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, cast

import click

from consat.cli import completion
from consat.cli.doctor import doctor, show_version
from consat.cli.examples import add_examples
from consat.cli.export import export, result_argument, show
from consat.cli.keys import keys
from consat.cli.live import live
from consat.cli.network import agent, launch, split
from consat.cli.options import (
    Burst,
    Listing,
    OneOf,
    estimates_option,
    films,
    force_option,
    full_option,
    json_option,
    out_option,
    scenario_argument,
    sends_option,
    set_option,
    words,
)
from consat.cli.schema import schema
from consat.cli.terminal import (
    DONE,
    FAILED,
    INTERRUPTED,
    INVALID,
    UNSATISFIED,
    USAGE,
    located,
    progress,
    say,
    show_rich,
    tell,
)
from consat.errors import ConsatError, InvalidInput, InvalidSettings, closest
from consat.network.deploy.environment import keep_compilations

if TYPE_CHECKING:
    from consat.scenario import Scenario


def main() -> NoReturn:
    """Entry point of the ``consat`` command."""
    gc.set_threshold(10_000)  # with the default threshold a sixth of a short run is spent in garbage collection
    for stream in (sys.stdout, sys.stderr):
        stream.reconfigure(errors="replace")  # type: ignore[union-attr]
    try:
        sys.exit(cli.main(standalone_mode=False, prog_name="consat"))
    except click.ClickException as error:
        error.show()
        sys.exit(error.exit_code)
    except click.exceptions.Abort:
        sys.exit(INTERRUPTED)
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)
    except InvalidInput as error:
        say(str(error))
        sys.exit(INVALID)
    except InvalidSettings as error:
        say(f"consat: {error}")
        sys.exit(USAGE)
    except ConsatError as error:
        say(f"consat: {error}")
        sys.exit(FAILED)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(FAILED)
    except OSError as error:
        say(f"consat: {error.filename or ''}: {error.strerror or error}")
        sys.exit(FAILED)
    finally:
        gc.freeze()  # skips the garbage collection of all of JAX at exit


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.option("--version", is_flag=True, is_eager=True, expose_value=False, callback=show_version, help="Show the versions and the device.")
def cli() -> None:
    """A team of robots that satisfies its private constraints together.

    FILE is a scenario file, or the name of a packaged scenario such as case-b.
    """


@cli.command()
@click.argument("name", required=False, shell_complete=completion.scenarios)
def init(name: str | None) -> None:
    """Write a scenario to begin with, to NAME.yaml.

    The name of a packaged scenario gives a copy of that one.
    """
    from consat.scenario import packaged, packaged_text, template

    if name and not name.endswith((".yaml", ".yml")) and name not in packaged() and (hint := closest(name, packaged())):
        raise click.UsageError(f"there is no packaged scenario {name!r}{hint} For an empty scenario of that name: consat init {name}.yaml")
    target = Path(name if name and name.endswith((".yaml", ".yml")) else f"{name or 'scenario'}.yaml")
    text = packaged_text(name) if name in packaged() else template()
    try:
        with target.open("x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError:
        raise click.UsageError(f"{target} exists already; choose another name") from None
    click.echo(f"{target} written; now: consat run {target}", err=True)


def _numbers(context: click.Context, parameter: click.Parameter, value: str | None) -> tuple[float, ...]:
    try:
        return tuple(float(each) for each in value.split(",")) if value else ()
    except ValueError:
        raise click.BadParameter(f"{value!r} must be numbers, such as 0.1,0 for wind along x") from None


def _names(context: click.Context, parameter: click.Parameter, value: str | None) -> Any:
    return value if value in (None, "all", "none") else [name.strip() for name in str(value).split(",")]


@cli.command()
@click.argument("scenario", metavar="FILE", required=False, shell_complete=completion.scenarios)
@set_option
@click.option(
    "--protocol",
    metavar="KIND",
    shell_complete=completion.protocols,
    cls=Listing,
    listed=words("consat.settings", "ProtocolKind"),
    help="One of {}; interior-point if not given, or admm for large teams.",
)
@estimates_option
@click.option("--seed", type=click.IntRange(min=0), help="Of starts and first estimates; overrides start.seed.")
@click.option("--rounds", type=click.IntRange(min=0), help="How many rounds; implies --stop never.")
@click.option(
    "--until",
    type=click.FloatRange(min=0, min_open=True),
    metavar="SECONDS",
    help="End of the run; implies --stop never. In rounds with --rate.",
)
@click.option("--stop", type=OneOf(words("consat.settings", "Stop")), help="When to end earlier.")
@click.option("--loss", type=click.FloatRange(0, 1, max_open=True), default=0.0, help="Probability that a message is lost.")
@click.option("--sleep", type=click.FloatRange(0, 1, max_open=True), default=0.0, help="Probability that an agent skips a round.")
@click.option("--burst", type=Burst(), help="Links turn bad with probability P a round, good again with Q.")
@click.option("--rate", type=click.FloatRange(min=0, min_open=True), metavar="HZ", help="Rounds a second, where rounds take time.")
@click.option("--speed", type=click.FloatRange(min=0, min_open=True), help="The most that a body moves, length/s; needs --rate.")
@click.option("--robots", type=OneOf(words("consat.scenario.robots", "KINDS")), help="What bodies are; by default the scenario's.")
@click.option("--wind", callback=_numbers, metavar="VX,VY", help="Velocity of the air, m/s, for robots.")
@click.option("--noise", type=click.FloatRange(min=0), default=0.0, metavar="M", help="What a robot's position is measured wrong by, m.")
@click.option("--simulator", metavar="NAME", cls=Listing, listed=words("consat.robots.simulated", "SIMULATORS"),
              help="Integrates the bodies of robots: {}; by default the robots' own models do.")  # fmt: skip
@sends_option
@click.option("--auxiliary", type=click.FloatRange(min=0, min_open=True), metavar="RADIUS", help="Keep every agent in this ball, too.")
@click.option("--restarts", type=click.IntRange(min=1), metavar="K",
              help="Run from K starts, and tell of the best; by default 1, then 5 if constraints of mixed curvature fail.")  # fmt: skip
@out_option
@force_option
@click.option("--every", type=click.IntRange(min=1), default=1, metavar="K", help="Record each K-th round, or sample of a flow.")
@click.option(
    "--record",
    "agents",
    metavar="IDS",
    shell_complete=completion.agents,
    callback=_names,
    help="Of whom to record: a1,a2, all or none; of large teams a sample, if not given.",
)
@click.option("--checkpoint", is_flag=False, flag_value="10", type=click.FloatRange(min=0), metavar="SECONDS",
              help="Keep the state in --out, each so many seconds (10 if not said), to go on from with --resume.")  # fmt: skip
@click.option(
    "--resume", type=click.Path(file_okay=False, path_type=Path), metavar="DIR", help="Go on with a run that kept checkpoints there."
)
@click.option("--processes", type=click.IntRange(min=1), metavar="K", help="Run in K processes on this machine.")
@click.option("--coordinator", metavar="HOST:PORT", help="Join others: where process 0 listens; see docs/cluster.md.")
@click.option("--process", type=click.IntRange(min=0), metavar="I", help="Number of this process among them, from 0.")
@click.option("--of", type=click.IntRange(min=1), metavar="K", help="How many they are.")
@full_option
@click.option("--quiet", is_flag=True, help="No progress bar and no summary.")
@json_option
def run(
    scenario: str | None, overrides: tuple[str, ...], resume: Path | None, full: bool, quiet: bool, as_json: bool, **settings: Any
) -> int:  # fmt: skip
    """Run the distributed protocol."""
    keep_compilations(os.environ)
    if not _meet(*(settings.pop(name) for name in ("processes", "coordinator", "process", "of"))):
        quiet, as_json = True, False  # only process 0 prints
    out = settings["out"] = resume or settings["out"]
    _fit_together(scenario, resume, out, settings["checkpoint"])
    loaded = None if scenario is None else _load(scenario, overrides)
    from consat.runs import runner

    with progress(quiet or as_json, settings["rounds"] or settings["until"]) as report, located(loaded):
        if loaded is None:
            kept = {key: settings[key] for key in ("rounds", "until", "checkpoint")}
            result = runner.resume(cast(Path, resume), full=full, progress=report, **kept)
        else:
            result = runner.run(loaded, full=full, progress=report, **settings)
    if settings["auxiliary"] is not None:
        _say_auxiliary(settings["auxiliary"], result.binding("auxiliary"))
    if result.summary["result"] is not None and out is not None:
        figures = result.plot(out)
        if not (quiet or as_json):
            say(f"written: {', '.join(map(str, (result.summary['result'], *figures)))}")
    return tell(result, quiet=quiet, as_json=as_json)


def _meet(processes: int | None, coordinator: str | None, process: int | None, of: int | None) -> bool:
    """Join the other processes, or start them. Returns whether this process prints the result."""
    if processes is None and not {coordinator, process, of} - {None} and "CONSAT_COORDINATOR" not in os.environ:
        return True
    from consat import processes as together

    where = together.asked(coordinator, process, of, os.environ)
    if where is not None:
        together.join(*where)
    elif processes is not None and processes > 1:
        sys.exit(together.launch(sys.argv[1:], processes))
    return where is None or where[1] == 0


def _fit_together(scenario: str | None, resume: Path | None, out: Path | None, checkpoint: float | None) -> None:
    if (scenario is None) == (resume is None):
        raise click.UsageError("give a scenario, FILE, to run, or --resume DIR to go on with a run; not both, not neither")
    if checkpoint is not None and out is None:
        raise click.UsageError("--checkpoint needs --out DIR, where the checkpoint will stand beside the result")


@cli.command()
@scenario_argument
@set_option
@json_option
def check(scenario: str, overrides: tuple[str, ...], as_json: bool) -> int:
    """Check a scenario: faults, graphs, assumptions, curvature.

    That is its schema, task and communication graph, clusters, the paper's assumptions, and the curvature of every constraint.
    """
    keep_compilations(os.environ)
    loaded = _load(scenario, overrides)
    from consat.certify.assumptions import report
    from consat.problem.graphs import require_connected
    from consat.runs.preparation import protocol_entries

    findings = report(loaded.team)
    if findings["communication_connected"]:
        findings |= protocol_entries(loaded.team, loaded.settings.protocol)
    findings["warnings"] = []
    if loaded.robots is not None:
        from consat.scenario.robots import blocked_goals

        findings["warnings"] = blocked_goals(loaded.robots, loaded.team)
    if as_json:
        click.echo(json.dumps(findings))
    else:
        from consat.views import tables

        show_rich(tables.check(loaded.name, findings))
    with located(loaded):
        require_connected(loaded.team)
    return DONE


@cli.command()
@scenario_argument
@set_option
@click.option("--seed", type=click.IntRange(min=0), default=0, help="Of the starts, where there are many.")
@click.option("--auxiliary", type=click.FloatRange(min=0, min_open=True), metavar="RADIUS", help="Keep every agent in this ball, too.")
@json_option
def solve(scenario: str, overrides: tuple[str, ...], seed: int, auxiliary: float | None, as_json: bool) -> int:
    """Find the best margin centrally, and prove it.

    Says also what binds, or what stands in the way, and what the least change is that would help.
    """
    keep_compilations(os.environ)
    loaded = _load(scenario, overrides)
    from consat.runs.solving import solve as solve_team

    with located(loaded):
        answer = solve_team(loaded, seed=seed, auxiliary=auxiliary)
    if answer["auxiliary"] is not None:
        _say_auxiliary(answer["auxiliary"]["radius"], answer["auxiliary"]["binding"])
    if as_json:
        click.echo(json.dumps(answer))
    else:
        from consat.views import tables

        show_rich(tables.solve(answer))
    return DONE if answer["verdict"] == "feasible" else UNSATISFIED


@cli.command()
@scenario_argument
@set_option
@click.option(
    "--over", multiple=True, metavar="PATH=VALUES", help="Values to try, v1,v2,… or FROM:TO:COUNT; a path as in --set, loss or sleep."
)
@click.option("--seeds", type=click.IntRange(min=1), default=1, metavar="COUNT", help="How many seeds for each combination of values.")
@click.option("--seed", type=click.IntRange(min=0), help="The first of them; start.seed if not given.")
@click.option("--protocol", metavar="KIND", shell_complete=completion.protocols, help="As for run, as is all that follows.")
@click.option("--estimates", type=OneOf(words("consat.settings", "Layout")))
@click.option("--rounds", type=click.IntRange(min=0))
@click.option("--until", type=click.FloatRange(min=0, min_open=True), metavar="SECONDS")
@click.option("--stop", type=OneOf(words("consat.settings", "Stop")))
@click.option("--loss", type=click.FloatRange(0, 1, max_open=True), default=0.0)
@click.option("--sleep", type=click.FloatRange(0, 1, max_open=True), default=0.0)
@click.option("--auxiliary", type=click.FloatRange(min=0, min_open=True), metavar="RADIUS")
@click.option(
    "--out", type=click.Path(file_okay=False, path_type=Path), metavar="DIR", help="Write sweep.json, sweep.csv and a figure there."
)
@force_option
@click.option("--full", is_flag=True, help="List every run in the JSON, however many.")
@json_option
def sweep(
    *, scenario: str, overrides: tuple[str, ...], over: tuple[str, ...], seed: int | None,
    out: Path | None, force: bool, as_json: bool, **settings: Any,
) -> int:  # fmt: skip
    """Run many seeds and parameter values as one computation.

    Runs every combination of the values, each with every seed.
    """
    keep_compilations(os.environ)
    if wrong := [text for text in over if not all(text.partition("="))]:
        raise click.UsageError(
            f"--over {wrong[0]}: this must be PATH=VALUES, such as loss=0,0.1,0.3 or agents.a1.constraints.0.radius=0.5:2:16"
        )
    paths = [text.partition("=")[0].strip() for text in over]
    if repeated := [path for path in paths if paths.count(path) > 1]:
        raise click.UsageError(f"--over {repeated[0]} is given twice; write all its values in one, {repeated[0]}=v1,v2,…")
    loaded = _load(scenario, (*overrides, *([] if seed is None else [f"start.seed={seed}"])))
    from consat.engine.files import claim
    from consat.runs.sweeping import sweep as sweep_team
    from consat.runs.sweeping import values
    from consat.views import tables

    if out is not None:
        claim(out, loaded.name, force=force)
    options = {path: values(text.partition("=")[2]) for path, text in zip(paths, over, strict=True)}
    with progress(as_json, share=True) as report, located(loaded):
        found = sweep_team(loaded, options, progress=report, **settings)
    if out is not None:
        say(f"written: {', '.join(map(str, found.save(out)))}")
    if as_json:
        click.echo(json.dumps(found.summary))
    else:
        show_rich(tables.sweep(found.summary))
    return DONE if all(group["success"] == 1 for group in found.summary["groups"]) else UNSATISFIED


@cli.command()
@result_argument
@click.option("--out", type=click.Path(file_okay=False, path_type=Path), metavar="DIR", help="Where to; beside the result if not given.")
def plot(result: Path, out: Path | None) -> None:
    """Draw the figures of a saved RESULT, a file or the DIR of a run."""
    keep_compilations(os.environ)
    from consat.results.result import Result

    for path in Result.load(result).plot(out or _file(result).parent):
        click.echo(path)


@cli.command()
@result_argument
@click.option("--out", type=click.Path(dir_okay=False, path_type=Path), metavar="FILM", cls=Listing, listed=films,
              help="Where to, one of {}; a GIF beside the result if not given.")  # fmt: skip
def animate(result: Path, out: Path | None) -> None:
    """Make a film of a saved RESULT, a file or the DIR of a run."""
    keep_compilations(os.environ)
    from consat.results.result import Result
    from consat.views import animation

    loaded = Result.load(result)
    with progress(quiet=False) as report:
        click.echo(animation.save(loaded, out or _file(result).with_suffix(".gif"), progress=lambda done: report(done, None)))


def _file(result: Path) -> Path:
    """Path of the result file, given that file or the directory of a run."""
    from consat.results.result import RESULT

    return result / RESULT if result.is_dir() else result


for command in (split, agent, launch, keys, export, show, live, schema, doctor):
    cli.add_command(command)
add_examples(cli)


def _load(scenario: str, overrides: tuple[str, ...]) -> Scenario:
    from consat.scenario import load

    return load(scenario, overrides)


def _say_auxiliary(radius: float, binding: list[str]) -> None:
    say(f"auxiliary constraint added: every agent stays within {radius:g} of the team's middle")
    if binding:
        few = ", ".join(binding[:5]) + (", …" if len(binding) > 5 else "")
        say(f"it binds on {few}: the answer is that of the changed team; take a larger radius")
