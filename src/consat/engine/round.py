"""One round, for all agents at once: everybody speaks, the messages travel (or don't), everybody hears."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from consat.engine.live import Live
from consat.faults import Draw, Faults, draw
from consat.numerics import Groups, on_device, pick
from consat.problem.family import distinct
from consat.problem.graphs import hops
from consat.problem.objective import Nu, Objective
from consat.problem.team import Team
from consat.problem.units import Region, Scale
from consat.protocols import InteriorPoint, Known, Rounds, agreement, sending
from consat.protocols.estimates import Estimates
from consat.protocols.interior_point import EXACTLY, near
from consat.protocols.local import proximal as prox
from consat.protocols.local.interior import Interior
from consat.protocols.sending import HEADER, Crossing, Held
from consat.protocols.solver import EXACT, LocalSolver

if TYPE_CHECKING:
    from consat.robots.drive import Drive

PATH = 8
"""Waypoints of a path, of which few have so many; where one has more, rounds are compiled once more."""
QUICK = prox.Precision(tolerance=None)
"""Of every local step of a large team: there the arithmetic counts, and an exact step saves no rounds. Each begins where the last ended, so
that the steps become exact as the team comes to rest."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Ends:
    """Both ends of every link of every copy: `consat.protocols.Links` of all agents at once.

    Attributes:
        other: (B,) the index of the same link's other end, in blocks of copies; see `consat.protocols.estimates.Estimates.ends`.
        groups: groups the ends by copy, in blocks.
        degree: (C,).
        metropolis: (E,).
        block: copies in a block.
    """

    other: Array
    groups: Groups
    degree: Array
    metropolis: Array
    block: int = field(metadata={"static": True})

    @classmethod
    def of(cls, receiver: np.ndarray, sender: np.ndarray, block: int, copies: int) -> Ends:
        """Args: receiver, sender, block: see `consat.protocols.estimates.Estimates.ends`; copies: C."""
        here, there, count = receiver.astype(np.int64), sender.astype(np.int64), copies // block
        other = np.searchsorted(here * count + there, there * count + here)
        degree = np.bincount(receiver, minlength=count)
        metropolis = 1.0 / (1.0 + np.maximum(degree[receiver], degree[sender]))
        return cls(
            on_device(other.astype(np.int32)),
            Groups.of(receiver, count),
            on_device(np.repeat(degree.astype(float), block)),
            on_device(np.repeat(metropolis, block)),
            block,
        )

    def __len__(self) -> int:
        return len(self.metropolis)

    def at(self, rows: Array) -> Array:
        return self._in_blocks(self.groups.spread, rows)

    def sum(self, links: Array) -> Array:
        return self._in_blocks(self.groups.sum, links)

    def least(self, links: Array) -> Array:
        return -self._in_blocks(self.groups.max, -links)

    def across(self, links: Array) -> Array:
        """(E, …) → (E, …): what stands at the other ends."""
        return self._in_blocks(lambda blocks: pick(blocks, self.other), links)

    def _in_blocks(self, function: Callable[[Array], Array], values: Array) -> Array:
        if self.block == 1:
            return function(values)
        found = function(values.reshape(-1, self.block, *values.shape[1:]))
        return found.reshape(-1, *found.shape[2:])


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Everyone(LocalSolver):
    """All agents at once.

    Attributes:
        links: all ends.
        agents: N.
    """

    links: Ends
    agents: int = field(metadata={"static": True})


@dataclass(frozen=True)
class Body:
    """A body cannot jump: p ← p + clip(x − p) to at most speed/rate a round.

    Attributes:
        rate: rounds a second, Hz.
        speed: the most that a body moves, length/s; if infinite it is where its agent wants to be.
        drive: the robots that bodies are; None for bodies that move as they are told.
        wind: (d,) velocity of the air, m/s.
        noise: the most that a measured position is wrong by, m.
    """

    rate: float
    speed: float = np.inf
    drive: Drive | None = None
    wind: tuple[float, ...] = ()
    noise: float = 0.0

    @property
    def reach(self) -> float | None:
        """The most that it moves in a round; None without limit."""
        if self.drive is not None:
            return float(np.max(np.asarray(self.drive.model.pace(self.drive.count)))) / self.rate
        return self.speed / self.rate if np.isfinite(self.speed) else None


class Seen(NamedTuple):
    """What an observer of the whole team sees after each round; leading axis T."""

    heading: Any
    position: Any
    margin: Any
    smooth_margin: Any
    agent_margin: Any
    estimate: Any
    known: Any
    bound: Any
    messages: Any
    floats: Any
    bytes: Any


class Sent(NamedTuple):
    """What was sent in a round, in all: messages, numbers in them, and bytes of both, names and shapes apart."""

    messages: Array
    floats: Array
    bytes: Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Part:
    """How the agents of a process stand in the whole team. They come first; behind them the neighbours of other processes.

    Attributes:
        agent: (n,) numbers in the team.
        pair: numbers of the pairs.
        ours: (n,) whose agents they are: this process's.
        agents: N of the team.
        pairs: of the team.
    """

    agent: Array
    pair: Array
    ours: Array
    agents: int = field(metadata={"static": True})
    pairs: int = field(metadata={"static": True})


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class World:
    """Everything a round needs that does not change.

    Attributes:
        everyone: the agents.
        observer: of their true positions.
        own: (N,) rows of own positions.
        talker: (E,) who speaks at each end.
        pair: (E,) the directed pair of agents that each end belongs to: a message carries all its copies.
        reach: most that a body moves in a round; None if it can jump.
        owners: see `consat.protocols.agreement`; None where bodies can jump and agents go by their estimates of one another.
        loss: see `consat.faults.Faults`.
        sleep: see `consat.faults.Faults`.
        pairs: how many directed pairs.
        rough: whether messages can be lost or agents sleep.
        part: of which larger team this is a part; None of none.
        live: what may change of the constraints; None where nothing does.
        drive: the robots that bodies are; None of none.
        wind: (d,) velocity of the air, m/s; None where it is still.
        noise: the most that a measured position is wrong by, m; None where they are exact.
        burst: (2,) see `consat.faults.Faults`; None without.
        events: whether agents send only what is news, see `consat.protocols.sending`.
    """

    everyone: Everyone
    observer: Objective
    own: Array
    talker: Array
    pair: Array
    reach: Array | None
    owners: agreement.Owners | None
    loss: Array
    sleep: Array
    pairs: int = field(metadata={"static": True})
    rough: bool = field(metadata={"static": True})
    part: Part | None = None
    live: Live | None = None
    wind: Array | None = None
    noise: Array | None = None
    burst: Array | None = None
    drive: Drive | None = field(default=None, metadata={"static": True})
    events: bool = field(default=False, metadata={"static": True})

    def at(self, round_: Array) -> World:
        """With the constraints as they are after so many rounds."""
        if self.live is None:
            return self
        values = self.live.at(round_)
        return replace(self, everyone=self.everyone.with_parameters(values), observer=self.observer.with_parameters(values))


class Driven(NamedTuple):
    """What robots are in, and carry on.

    Attributes:
        state: of the models.
        memory: of `consat.robots.drive`.
        paths: (N, W, d) the ways that they have planned; None where nothing is in the way.
    """

    state: Any
    memory: Any
    paths: Array | None


class Now(NamedTuple):
    """Everything a round changes: what the agents remember, where their bodies are, and the key of what goes wrong.

    Attributes:
        state: of the protocol.
        ages: of `consat.protocols.agreement`.
        body: (N, d).
        key: of the random draws.
        heard: what they know of each other's bodies; None where bodies can jump.
        robots: what bodies are; None where they are points.
        bad: (pairs,) between whom nothing gets through for now; None where losses do not come in bursts.
        held: what neighbours hold of what they said; None where everything is sent.
    """

    state: Any
    ages: agreement.Ages
    body: Array
    key: Array
    heard: agreement.Bodies | None = None
    robots: Driven | None = None
    bad: Array | None = None
    held: Held | None = None


class Spoken(NamedTuple):
    """Between speaking and hearing.

    Attributes:
        state: of the protocol, after its step.
        ages: likewise.
        body: (N, d) likewise.
        heard: likewise.
        crossing: what stands at each end, on its way to the other.
        went: (E,) whether it was sent and not lost; None where nothing is.
        reached: (P,) the same of the message to each neighbour; None where nobody asks.
        key: of the random draws that follow.
        sent: how much.
        robots: likewise.
        bad: likewise.
        held: likewise.
    """

    state: Any
    ages: agreement.Ages
    body: Array
    heard: agreement.Bodies | None
    crossing: Crossing
    went: Array | None
    reached: Array | None
    key: Array
    sent: Sent
    robots: Driven | None = None
    bad: Array | None = None
    held: Held | None = None


def one_round(protocol: Rounds, world: World, now: Now, round_: Array) -> tuple[Now, Seen]:
    """What all agents do in one round."""
    spoken = speak(protocol, world, now, round_)
    now, known = hear(protocol, world, spoken)
    return now, see(world, now, known, spoken.sent)


def speak(protocol: Rounds, world: World, now: Now, round_: Array) -> Spoken:
    """The first half of a round."""
    everyone = world.everyone
    at = now.state.x if now.heard is None else now.heard.position
    known = Known(agreement.known(now.ages, everyone), everyone.margin(at))
    state, message = protocol.speak(now.state, everyone, round_, known)
    ages, told = agreement.speak(now.ages, state.x, everyone)
    key, awake, through, bad = now.key, None, None, now.bad
    if world.rough:
        key, awake, through, bad = _drawn(world, now.key, now.bad)
        state = _where_awake(protocol.per, world, awake, state, now.state)
        ages = _where_awake(_AGES, world, awake, ages, now.ages)
    targets = pick(state.x, world.own)
    if now.robots is None or world.drive is None:
        body, robots = _moved(now.body, targets, world.reach), None
    else:
        robots = _driven(world, world.drive, now.robots, targets, jax.random.fold_in(now.key, round_.astype(jnp.int32)))
        body = world.drive.position(robots.state)
    heard, word = now.heard, None
    if now.heard is not None and world.owners is not None:
        heard, word = agreement.speak_bodies(now.heard, body, world.owners, everyone)
        if awake is not None:
            heard = _where_awake(_BODIES, world, awake, heard, now.heard)
    crossing, held, goes = Crossing(message, told, word), now.held, awake
    if held is not None:
        talks = None if awake is None else _of_pairs(world, awake)
        crossing, held, goes = sending.sifted(
            protocol, everyone, crossing, held, world.pair, beat=float(sending.BEAT), lasting=not world.rough, talks=talks
        )
    elif awake is not None:
        goes = _of_pairs(world, awake)
    reached = goes if through is None else through if goes is None else goes & through
    if through is None:  # silence, where nothing gets lost, says that all is as before
        reached = jnp.ones(world.pairs, bool) if protocol.speaks == "pair" else None
    went = None if through is None or reached is None else reached[world.pair]
    return Spoken(state, ages, body, heard, crossing, went, reached, key, _sent(protocol, world, crossing, goes), robots, bad, held)


def _of_pairs(world: World, agents: Array) -> Array:
    """(N,) → (pairs,): to each pair the value of the one who speaks."""
    return jax.ops.segment_max(agents[world.talker].astype(int), world.pair, world.pairs) > 0


def _sent(protocol: Rounds, world: World, crossing: Crossing, goes: Array | None) -> Sent:
    """How much was sent, where it went, (pairs,); everywhere if None."""
    everyone, ends, word = world.everyone, world.everyone.links, crossing.word
    per_copy = jax.tree.leaves((crossing.message if protocol.speaks == "link" else (), () if word is None else (word.position, word.stale)))
    width = sum(leaf.size // max(len(ends), 1) for leaf in per_copy)
    ours = None if world.part is None else world.part.ours[world.talker]  # the others' messages are counted where they are sent
    if goes is None and ours is None:
        messages, copies = jnp.asarray(world.pairs), jnp.asarray(len(ends))
    else:
        went = jnp.ones(len(ends), bool) if goes is None else goes[world.pair]
        went = went if ours is None else went & ours
        messages = jnp.sum(jax.ops.segment_max(went.astype(int), world.pair, world.pairs))
        copies = jnp.sum(went)
    floats, less = (messages if word is None else 2 * messages) + copies * width, jnp.asarray(0)
    if protocol.speaks == "pair" and everyone.interior is not None:
        plan = everyone.interior.plan
        talks = jnp.ones(world.pairs, bool) if goes is None else goes
        floats += jnp.sum(jnp.where(talks, plan.floats, 0))
        less = jnp.sum(jnp.where(talks, plan.singles, 0)) if world.events else less
    return Sent(messages, floats, HEADER * messages + 8 * floats - 4 * less)


_AGES: Mapping[str, Any] = {"age": "agent", "heard": "link"}
_BODIES: Mapping[str, Any] = {"position": "row", "stale": "row", "ages": _AGES}


def _drawn(world: World, key: Array, bad: Array | None) -> Draw:
    part = world.part
    agents, pairs = (
        ((world.everyone.agents, None), (world.pairs, None)) if part is None else ((part.agents, part.agent), (part.pairs, part.pair))
    )
    return draw(key, bad, loss=world.loss, sleep=world.sleep, burst=world.burst, agents=agents, pairs=pairs)


def hear(protocol: Rounds, world: World, spoken: Spoken) -> tuple[Now, tuple[Array, Array]]:
    """The second half of a round; tells also what all know, see `knowledge`."""
    everyone, ends = world.everyone, world.everyone.links
    arrived = jnp.ones(len(ends), dtype=bool) if spoken.went is None else ends.across(spoken.went)
    message, told, word = spoken.crossing
    told, word = jax.tree.map(ends.across, (told, word))
    if protocol.speaks == "pair" and everyone.interior is not None and spoken.reached is not None:
        interior = everyone.interior
        state = protocol.hear(spoken.state, interior.across(message), pick(spoken.reached, interior.other), everyone)
    else:
        state = protocol.hear(spoken.state, jax.tree.map(ends.across, message), arrived, everyone)
    ages, heard = agreement.hear(spoken.ages, told, arrived), spoken.heard
    if heard is not None and word is not None and world.owners is not None:
        heard = agreement.hear_bodies(heard, word, arrived, world.owners, everyone)
    known = agreement.known(ages if heard is None else heard.ages, everyone) > 0
    now = Now(state, ages, spoken.body, spoken.key, heard, spoken.robots, spoken.bad, spoken.held)
    return now, knowledge(protocol, world, now, known if world.part is None else known | ~world.part.ours)


SATISFIED, INFEASIBLE, NEAR, BEST = 1, 2, 4, 8
"""What all agents know, as bits: that all are satisfied; that the team cannot be satisfied; and that its margin is proven to be near the
best, or the best to `EXACTLY`."""


def knowledge(protocol: Rounds, world: World, now: Now, satisfied: Array) -> tuple[Array, Array]:
    """What all agents know, of `SATISFIED` and the others, and the bound on the best margin that all have proven, NaN where none is;
    `satisfied`: (N,) who knows that all are."""
    everyone = world.everyone
    known = jnp.where(jnp.all(satisfied), SATISFIED, 0)
    if not isinstance(protocol, InteriorPoint) or everyone.interior is None:
        return known, jnp.asarray(jnp.nan)
    margin = everyone.margin(now.state.x if now.heard is None else now.heard.position)
    bound, least = protocol.proven(now.state, everyone, margin)
    gap, unit = bound - least, everyone.interior.units.psi
    idle = jnp.isinf(margin) & (everyone.interior.degree == 0)
    torn = bound < 0
    proven = jnp.isfinite(bound)
    best = proven & (gap <= EXACTLY * jnp.maximum(unit, jnp.abs(bound)))
    some = jnp.any(torn)
    known += jnp.where(jnp.all(satisfied | torn | idle) & some, INFEASIBLE, 0)
    known += jnp.where(jnp.all(satisfied | (torn & near(bound, least, unit)) | idle) & some, NEAR, 0)
    most = jnp.max(jnp.where(idle, -jnp.inf, bound), initial=-jnp.inf)
    return known + jnp.where(jnp.all(best | idle), BEST, 0), jnp.where(jnp.isfinite(most), most, jnp.nan)


def _moved(body: Array, target: Array, reach: Array | None) -> Array:
    if reach is None:
        return target
    away = target - body
    distance = jnp.linalg.norm(away, axis=1, keepdims=True)
    return jnp.where(distance > reach, body + away * (reach / jnp.where(distance > 0, distance, 1.0)), target)


def _driven(world: World, drive: Drive, robots: Driven, targets: Array, key: Array) -> Driven:
    """Where robots are after they have driven towards their targets, (N, d), for a round; key: of what is measured wrong."""
    measured = None
    if world.noise is not None:
        direction = jax.random.normal(key, targets.shape)
        size = world.noise * jax.random.uniform(jax.random.fold_in(key, 1), (len(targets), 1))
        measured = drive.model.place(robots.state) + size * direction / jnp.linalg.norm(direction, axis=1, keepdims=True)
    wind = None if world.wind is None else jnp.broadcast_to(world.wind[None], targets.shape)
    paths = robots.paths
    if paths is not None:  # a way ends where the target is now
        end = jnp.all(paths == paths[:, -1:], axis=2, keepdims=True)
        paths = jnp.where(end, targets[:, None], paths)
    state, memory, _ = drive.step(robots.state, robots.memory, targets, paths=paths, measured=measured, wind=wind)
    return Driven(state, memory, robots.paths)


def see(world: World, now: Now, known: tuple[Array, Array], sent: Sent) -> Seen:
    """What an observer sees; known: see `knowledge`."""
    margins = world.observer.agent_margins(now.body)
    smooth = world.observer.smooth_margin(now.body, world.everyone.nu)
    turns = now.robots is not None and world.drive is not None
    heading = world.drive.model.heading(now.robots.state) if turns else jnp.zeros(0)  # type: ignore[union-attr]
    return Seen(heading, now.body, jnp.min(margins), smooth, margins, now.state.x, *known, *sent)


def _where_awake(per: Mapping[str, Any], world: World, awake: Array, new: Any, old: Any) -> Any:
    """The new state of those awake, the old one of those asleep."""
    masks = {"row": awake[world.everyone.holder], "link": awake[world.talker], "agent": awake}
    if (interior := world.everyone.interior) is not None:
        masks |= {"pair": awake[interior.talker], "constraint": awake[interior.owner]}

    def choose(per: str | Mapping[str, Any], fresh: Any, stale: Any) -> Any:
        if isinstance(per, str):
            return jax.tree.map(lambda a, b: jnp.where(masks[per].reshape(-1, *[1] * (a.ndim - 1)), a, b), fresh, stale)
        return type(fresh)(**{name: choose(kind, getattr(fresh, name), getattr(stale, name)) for name, kind in per.items()})

    return choose(per, new, old)


def many_rounds(
    protocol: Rounds, world: World, now: Now, numbers: Array, look: Callable[[Seen], Any] = lambda seen: seen
) -> tuple[Now, Any]:
    """The rounds of these numbers, and of each what `look` keeps, stacked."""

    def step(at: Now, number: Array) -> tuple[Now, Any]:
        at, seen = one_round(protocol, world, at, number)
        return at, look(seen)

    return jax.lax.scan(step, now, numbers)


def begin(protocol: Rounds, world: World, first: Array, key: Array) -> tuple[Now, Seen]:
    """The start from first estimates, (C, d), and what is seen of it."""
    start = first[world.own]
    heard = None if world.owners is None else agreement.start_bodies(first, world.everyone)
    robots = None
    if world.drive is not None:
        state = world.drive.model.start(start)
        paths = jnp.repeat(start[:, None], PATH, axis=1) if world.drive.map.count else None
        robots = Driven(state, world.drive.start(state), paths)
    bad = None if world.burst is None else jnp.zeros(world.pairs, bool)
    now = Now(protocol.start(first, world.everyone), agreement.start(first, world.everyone), start, key, heard, robots, bad)
    if world.events:
        now = now._replace(held=_nothing_held(protocol, world, now))
    nothing = jnp.asarray(0)
    seen = see(world, now, (nothing, jnp.asarray(jnp.nan)), Sent(nothing, nothing, nothing))
    return now, seen._replace(estimate=first)  # a protocol may begin from others


def _nothing_held(protocol: Rounds, world: World, now: Now) -> Held:
    """Before anything was said."""

    def said() -> Crossing:
        everyone = world.everyone
        known = Known(jnp.zeros(everyone.agents), jnp.zeros(everyone.agents))
        _, message = protocol.speak(now.state, everyone, jnp.asarray(0.0), known)
        word = None
        if now.heard is not None and world.owners is not None:
            _, word = agreement.speak_bodies(now.heard, now.body, world.owners, everyone)
        return Crossing(message, agreement.speak(now.ages, now.state.x, everyone)[1], word)

    crossing = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(said))
    word: agreement.Word | None = crossing.word
    return Held(crossing, jnp.full(world.pairs, agreement.NEVER), None if word is None else word.position)


def precision_for(count: int) -> prox.Precision:
    """Of the local steps of a team of so many agents."""
    return EXACT if count <= prox.SMALL_TEAM else QUICK


def world_of(
    team: Team,
    copies: Estimates,
    nu: Nu,
    size: Scale,
    *,
    convex: bool,
    faults: Faults,
    body: Body | None,
    speaks: str = "link",
    partial: bool = False,
    live: Live | None = None,
    events: bool = False,
) -> World:
    """Everything that does not change; arguments as in `consat.engine.rounds.simulate_rounds`; speaks: see `consat.protocols.Rounds`;
    partial: whether it is of one process among several, which must know whose messages to count; live: what may change; events: whether
    agents send only what is news."""
    receiver, sender, block = copies.ends()
    talker, listener = (np.repeat(copies.holder[rows * block], block) for rows in (receiver, sender))
    everyone = Everyone(
        links=Ends.of(receiver, sender, block, copies.count),
        length=on_device(size.length),
        region=Region.of(size),
        plan=prox.buckets(team, copies.rows, copies.count, convex, live=live is not None) if speaks == "link" else None,
        interior=Interior.of(team, copies, size) if speaks == "pair" else None,
        nu=Nu(on_device(nu.alpha), on_device(nu.beta)),
        local=Objective.of(team, lambda family: copies.rows(family.owner[:, None], family.agents), copies.count),
        holder=on_device(copies.holder),
        own=on_device(copies.own),
        talkers=Groups.of(talker, team.count),
        agents=team.count,
        hops=hops(team.count, copies.links),
        convex=convex,
        precision=precision_for(team.count),
    )
    rough = faults.loss > 0 or faults.sleep > 0 or faults.burst is not None
    keys = talker.astype(np.int64) * team.count + listener
    pairs = distinct(keys)
    if not (rough or partial or events):  # then nobody asks who is at the ends
        talker, keys = talker[:0], keys[:0]
    reach = None if body is None else body.reach
    return World(
        everyone=everyone,
        observer=Objective.at_positions(team),
        own=on_device(copies.own),
        talker=on_device(talker),
        pair=on_device(np.searchsorted(pairs, keys).astype(np.int32)),
        reach=None if reach is None else on_device(reach),
        owners=None if reach is None and speaks == "link" else _owners(copies, receiver, sender, block),
        loss=on_device(faults.loss),
        sleep=on_device(faults.sleep),
        pairs=len(pairs),
        rough=rough,
        live=live,
        wind=jnp.asarray(body.wind, dtype=float) if body is not None and any(body.wind) else None,
        burst=None if faults.burst is None else jnp.asarray(faults.burst, dtype=float),
        noise=on_device(body.noise) if body is not None and body.noise > 0 else None,
        drive=None if body is None else body.drive,
        events=events,
    )


def _owners(copies: Estimates, receiver: np.ndarray, sender: np.ndarray, block: int) -> agreement.Owners:
    row, other = ((ends.astype(np.int64)[:, None] * block + np.arange(block)).ravel() for ends in (receiver, sender))
    return agreement.Owners.of(copies.own, row, copies.holder[other] == copies.position[other], copies.count)
