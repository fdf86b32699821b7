"""``consat doctor``: information for bug reports, and checks of the installation."""

from __future__ import annotations

import json
import os
import platform
import socket
import time
from collections.abc import Iterator, Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Final

import click

from consat import __version__
from consat.cli.options import json_option
from consat.cli.terminal import DONE, FAILED
from consat.network.deploy.environment import keep_compilations

SCHEMA: Final = "consat.doctor/1"
LIBRARIES: Final = ("jax", "jaxlib", "numpy", "scipy", "diffrax", "clarabel", "xarray", "h5netcdf", "matplotlib", "click")
EXTRAS: Final[Mapping[str, Sequence[str]]] = {
    "live": ("starlette", "uvicorn", "websockets"),
    "mcap": ("foxglove-sdk",),
    "mujoco": ("mujoco-core",),
    "network": ("cryptography", "eclipse-zenoh"),
    "notebook": ("anywidget",),
    "video": ("av",),
}
"""For each extra the libraries that it installs."""
PORT: Final = 7447


def _version(library: str) -> str | None:
    try:
        return version(library)
    except PackageNotFoundError:
        return None


def device() -> str:
    """The devices of JAX, such as ``1 × cpu (cpu)``; the reason if there are none."""
    import jax

    try:
        devices = jax.devices()
    except RuntimeError as error:
        return f"no device: {str(error).splitlines()[0]}"
    kinds = sorted({each.device_kind for each in devices})
    return f"{len(devices)} × {', '.join(kinds)} ({devices[0].platform})"


def show_version(context: click.Context, parameter: click.Parameter, value: bool) -> None:
    """Callback of ``--version``: print the versions and exit."""
    if value and not context.resilient_parsing:
        click.echo(f"consat {__version__}, JAX {_version('jax')} on {device()}, Python {platform.python_version()}")
        context.exit()


def _compiles() -> float | None:
    """Time, s, to compile and run a small program; None if it does not run."""
    import jax
    import jax.numpy as jnp

    start = time.perf_counter()
    try:
        found = float(jax.jit(lambda x: jnp.sum(x**2))(jnp.arange(4.0)))
    except RuntimeError:
        return None
    return time.perf_counter() - start if found == 14.0 else None


def _cache() -> dict[str, Any]:
    keep_compilations(os.environ)
    place = Path(os.environ["JAX_COMPILATION_CACHE_DIR"])
    sizes = [entry.stat().st_size for entry in place.iterdir() if entry.is_file()] if place.is_dir() else []
    near = place
    while not near.exists():
        near = near.parent
    return {"place": str(place), "files": len(sizes), "bytes": sum(sizes), "writable": os.access(near, os.W_OK)}


def _loopback() -> dict[str, Any]:
    """Whether processes of this machine can reach each other over loopback, and whether the first agent's port is free."""
    reaches = free = True
    try:
        with socket.create_server(("127.0.0.1", 0)) as server, socket.create_connection(server.getsockname()[:2], timeout=2.0) as client:
            accepted, _ = server.accept()
            with accepted:
                client.sendall(b"consat")
                reaches = accepted.recv(6) == b"consat"
    except OSError:
        reaches = False
    try:
        socket.create_server(("127.0.0.1", PORT)).close()
    except OSError:
        free = False
    return {"reachable": reaches, "port": PORT, "free": free}


def findings() -> dict[str, Any]:
    """The document that ``--json`` prints (schema consat.doctor/1)."""
    cache = _cache()
    return {
        "schema": SCHEMA,
        "version": __version__,
        "python": platform.python_version(),
        "platform": platform.platform(),
        "cpus": os.cpu_count(),
        "libraries": {library: _version(library) for library in LIBRARIES},
        "device": device(),
        "compiles": _compiles(),
        "cache": cache,
        "extras": {
            extra: {"installed": all(map(_version, needed)), "libraries": {library: _version(library) for library in needed}}
            for extra, needed in EXTRAS.items()
        },
        "loopback": _loopback(),
    }


def _lines(found: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    yield "consat", f"{found['version']}, Python {found['python']}, {found['platform']}, {found['cpus']} CPUs"
    yield "libraries", ", ".join(f"{library} {number or 'missing'}" for library, number in found["libraries"].items())
    works = "does not compute" if found["compiles"] is None else f"compiles and computes in {found['compiles']:.2f} s"
    yield "device", f"{found['device']}; {works}"
    cache = found["cache"]
    state = "" if cache["writable"] else "; it cannot be written: set JAX_COMPILATION_CACHE_DIR"
    yield "compile cache", f"{cache['place']}, {cache['files']} programs, {cache['bytes'] / 2**20:.1f} MiB{state}"
    for extra, state in found["extras"].items():
        there = ", ".join(f"{library} {number}" for library, number in state["libraries"].items())
        yield f"consat[{extra}]", there if state["installed"] else f"not installed: pip install 'consat[{extra}]'"
    loopback = found["loopback"]
    port = "free" if loopback["free"] else "taken: use --port for launch and split"
    yield (
        "loopback",
        f"{'works' if loopback['reachable'] else 'does not work: agents as processes cannot talk'}; port {loopback['port']} {port}",
    )


@click.command()
@json_option
def doctor(as_json: bool) -> int:
    """Say what is installed and what works here, for bug reports."""
    found = findings()
    if as_json:
        click.echo(json.dumps(found))
    else:
        for name, text in _lines(found):
            click.echo(f"{name:<16}{text}")
    return DONE if found["compiles"] is not None and found["loopback"]["reachable"] else FAILED
