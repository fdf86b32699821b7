"""The live page in a real browser: a real mouse takes hold of things, and the team answers."""

from __future__ import annotations

import io
import time
from base64 import b64encode
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from PIL import Image

import consat as cs
from consat.server import display
from tests.browser import BROWSER, needs_browser
from tests.live.test_widget import Comm, message

if TYPE_CHECKING:
    from playwright.sync_api import Browser
    from playwright.sync_api import Page as Tab

pytestmark = needs_browser


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        found = playwright.chromium.launch(executable_path=BROWSER, args=["--no-sandbox", "--disable-gpu"])
        yield found
        found.close()


@pytest.fixture(scope="module")
def live() -> Iterator[Any]:
    with cs.live("case-b", seed=1, port=0, open_page=False, block=False) as found:
        yield found


@pytest.fixture
def tab(browser: Browser, live: Any) -> Iterator[Tab]:
    yield from opened(browser, live.url)


def opened(browser: Browser, url: str, **options: Any) -> Iterator[Tab]:
    context = browser.new_context(viewport={"width": 1280, "height": 800}, **options)
    found, said = context.new_page(), list[str]()
    found.on("pageerror", lambda error: said.append(str(error)))
    found.on("console", lambda message: said.append(message.text) if message.type == "error" else None)
    found.goto(url)
    until(found, "consat.agents().length > 0 && consat.round > 2 && consat.agents().every((each) => consat.where(each))")
    yield found
    context.close()
    assert not [each for each in said if "WebSocket" not in each], said


def until(tab: Tab, holds: str, seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while not tab.evaluate(holds):
        assert time.monotonic() < end, (holds, tab.evaluate("[consat.round, consat.margin, consat.verdict, consat.agents()]"))
        tab.wait_for_timeout(50)


def drag(tab: Tab, start: list[float], by: tuple[float, float]) -> None:
    tab.mouse.move(*start)
    tab.mouse.down()
    tab.mouse.move(start[0] + by[0] / 2, start[1] + by[1] / 2, steps=5)
    tab.mouse.move(start[0] + by[0], start[1] + by[1], steps=5)
    tab.mouse.up()


def test_mouse_drags_a_goal_and_the_team_follows_and_undoes(tab: Tab) -> None:
    until(tab, "consat.margin > 0.9")
    handle, before = tab.evaluate("consat.handle('a1', 'goal')"), tab.evaluate("consat.where('a1')")
    drag(tab, handle, (60, -60))
    until(tab, f"consat.margin > 0 && consat.where('a1')[0] > {before[0] + 25} && consat.where('a1')[1] < {before[1] - 25}")
    tab.get_by_label("Undo the last change").click()
    until(tab, f"consat.margin > 0.9 && Math.abs(consat.where('a1')[0] - {before[0]}) < 12")


def test_rim_changes_the_radius(tab: Tab) -> None:
    until(tab, "consat.margin > 0.9 && consat.verdict == 'feasible'")
    middle = tab.evaluate("consat.handle('a3', 'goal')")
    rim = next([middle[0] - r, middle[1]] for r in range(20, 160) if told(tab, middle[0] - r, middle[1]).startswith("a3: goal, radius"))
    drag(tab, rim, (-40, 0))
    until(tab, "consat.bounds && consat.bounds[1] > 1.05 || consat.reasons.join().includes('a1')")
    text = tab.evaluate("consat.send({do: 'text'})")["text"]
    goal = next(each for each in cs.loads(text).team.agents if each.id == "a3").constraints[0]
    assert goal.parameters["radius"].value > 1.2
    tab.keyboard.press("z")
    until(tab, "consat.bounds && Math.abs(consat.bounds[1] - 1) < 1e-3")


def told(tab: Tab, x: float, y: float) -> str:
    tab.mouse.move(x, y)
    tip = tab.locator("[data-part=tip]")
    return (tip.text_content() or "") if tip.is_visible() else ""


def test_team_torn_apart_says_why(tab: Tab) -> None:
    until(tab, "consat.margin > 0.9")
    drag(tab, tab.evaluate("consat.handle('a1', 'goal')"), (330, 0))
    until(tab, "consat.verdict == 'infeasible'")
    assert "can't be done, proven" in tab.locator("[data-part=verdict]").inner_text()
    assert "cannot all hold" in tab.locator("[data-part=reasons]").inner_text()
    tab.keyboard.press("z")
    until(tab, "consat.verdict == 'feasible' && consat.margin > 0.9")


def test_nothing_is_said_to_be_proven_of_a_team_that_has_changed_since(browser: Browser, monkeypatch: pytest.MonkeyPatch) -> None:
    """Assessments that take long come in while the goal moves on: the page goes on saying that it assesses."""
    find = display.assessed
    monkeypatch.setattr(display, "assessed", lambda team: (time.sleep(0.4), find(team))[1])
    watch = """() => {
        window.seen = [];
        const read = (name) => document.querySelector(`[data-part=${name}]`).textContent;
        setInterval(() => window.seen.push([read("verdict"), read("margin")]), 20);
    }"""
    with cs.live("case-b", seed=1, port=0, open_page=False, block=False) as own:
        for tab in opened(browser, own.url):
            until(tab, "consat.margin > 0.9 && consat.verdict == 'feasible'")
            drag(tab, tab.evaluate("consat.handle('a1', 'goal')"), (330, 0))
            until(tab, "consat.verdict == 'infeasible' && consat.margin < consat.bounds[1] + 0.01")
            tab.evaluate(watch)
            x, y = tab.evaluate("consat.handle('a1', 'goal')")
            tab.mouse.move(x, y)
            tab.mouse.down()
            for step in range(14):
                tab.mouse.move(x - 22 * step, y)
                tab.wait_for_timeout(250)
            tab.mouse.up()
            until(tab, "consat.verdict == 'feasible' && consat.margin > 0.5")
            number = lambda text: float(text.split()[-1].replace("−", "-"))  # noqa: E731
            seen = [(words, number(margin)) for words, margin in tab.evaluate("window.seen")]
            assert len({words for words, _ in seen}) >= 3
            assert not [(words, margin) for words, margin in seen if "can't be done" in words and margin > number(words) + 0.02]


def test_agent_is_killed_and_revived_and_a_link_that_must_stay_is_not_cut(tab: Tab) -> None:
    until(tab, "consat.margin > 0.9")
    tab.mouse.click(*tab.evaluate("consat.where('a2')"))
    tab.get_by_role("button", name="Cut the link between a2 and a1").click()
    tab.locator("[data-part=note].bad").wait_for()
    assert "without the link" in tab.locator("[data-part=note]").inner_text()
    tab.get_by_role("button", name="Kill a2").click()
    until(tab, "consat.agents().join() == 'a1,a3'")
    tab.locator("[data-part=rows] .silent").click()
    until(tab, "consat.agents().join() == 'a1,a2,a3' && consat.margin > 0.9")


def test_link_is_cut_by_the_mouse_and_healed(tab: Tab) -> None:
    assert tab.evaluate("consat.send({do: 'connect', one: 'a1', other: 'a3'})")["ok"]
    until(tab, "consat.margin > 0.9")
    tab.get_by_label("Pause").click()
    tab.evaluate("consat.send({do: 'place', agent: 'a2', position: [0, 2]})")  # off the line between the others
    tab.wait_for_timeout(300)
    a1, a3 = (tab.evaluate(f"consat.where('{each}')") for each in ("a1", "a3"))
    free = next(
        [a1[0] + t * (a3[0] - a1[0]), a1[1] + t * (a3[1] - a1[1])]
        for t in (k / 40 for k in range(1, 40))
        if told(tab, a1[0] + t * (a3[0] - a1[0]), a1[1] + t * (a3[1] - a1[1])) == "link a1 – a3"
    )
    tab.mouse.click(*free)
    tab.get_by_role("button", name="Cut the link between a1 and a3").click()
    tab.get_by_role("button", name="Heal the link between a1 and a3").click()
    tab.get_by_role("button", name="Heal the link between a1 and a3").wait_for(state="detached")
    tab.get_by_label("Play", exact=True).click()
    assert tab.evaluate("consat.send({do: 'disconnect', one: 'a1', other: 'a3'})")["ok"]


def test_two_browsers_see_the_same(browser: Browser, tab: Tab, live: Any) -> None:
    for other in opened(browser, live.url):
        tab.get_by_label("Pause").click()
        other.get_by_label("Play", exact=True).wait_for()
        until(other, f"consat.round == {tab.evaluate('consat.round')}")
        # Each glides to where the team is.
        settle(lambda other=other: other.evaluate("consat.where('a1')") == pytest.approx(tab.evaluate("consat.where('a1')"), abs=0.01))
        other.keyboard.press(" ")
        tab.get_by_label("Pause").wait_for()


def test_touch_drags_too(browser: Browser, live: Any) -> None:
    for tab in opened(browser, live.url, has_touch=True):
        until(tab, "consat.margin > 0.9")
        x, y = tab.evaluate("consat.handle('a1', 'goal')")
        before = tab.evaluate("consat.where('a1')")
        session = tab.context.new_cdp_session(tab)
        for kind, dx in (("touchStart", 0), ("touchMove", 30), ("touchMove", 60), ("touchEnd", 60)):
            points = [] if kind == "touchEnd" else [{"x": x + dx, "y": y}]
            session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})
            tab.wait_for_timeout(50)
        until(tab, f"consat.where('a1')[0] > {before[0] + 20}")
        tab.evaluate("consat.send({do: 'undo'})")


def choose(tab: Tab, agent: str) -> None:
    """By its row in the list, which stays where it is, unlike the agent."""
    row = tab.locator("[data-part=rows] button", has=tab.get_by_text(agent, exact=True))
    row.focus()
    tab.keyboard.press("Enter")
    tab.get_by_role("heading", name=f"agent {agent}").wait_for()


def test_every_control_has_a_name(tab: Tab) -> None:
    choose(tab, "a2")
    nameless = tab.evaluate("""[...document.querySelectorAll('button, input, select, canvas')]
        .filter((each) => !each.getAttribute('aria-label') && !(each.closest('label') ?? each).textContent.trim())
        .map((each) => each.outerHTML)""")
    assert nameless == []
    names = [each.get_attribute("aria-label") for each in tab.locator("[data-part=panel] button").all()]
    assert len(set(names)) == len(names)


def test_keyboard_does_what_a_mouse_does(tab: Tab) -> None:
    until(tab, "consat.margin > 0.9")
    choose(tab, "a1")
    before = goal_of(tab, "a1")
    tab.get_by_role("button", name="goal of a1: arrow keys").focus()
    tab.keyboard.press("ArrowRight")
    tab.keyboard.press("+")
    until(tab, "consat.margin > 0 && consat.verdict == 'feasible'")
    after = goal_of(tab, "a1")
    assert after["center"][0] > before["center"][0]
    assert after["radius"] == pytest.approx(1.1 * before["radius"])
    for _ in range(2):
        tab.keyboard.press("z")
    until(tab, "consat.margin > 0.9")
    assert goal_of(tab, "a1") == before
    tab.keyboard.press("k")
    tab.get_by_label("Play", exact=True).focus()  # else the arrow moves the region
    round_ = tab.evaluate("consat.round")
    tab.keyboard.press("ArrowRight")
    until(tab, f"consat.round == {round_ + 1}")
    tab.keyboard.press("k")
    tab.keyboard.press("Delete")
    until(tab, "consat.agents().join() == 'a2,a3'")
    tab.keyboard.press("z")
    until(tab, "consat.agents().join() == 'a1,a2,a3' && consat.margin > 0.9")


def goal_of(tab: Tab, agent: str) -> dict[str, Any]:
    team = cs.loads(tab.evaluate("consat.send({do: 'text'})")["text"]).team
    parameters = next(each for each in team.agents if each.id == agent).constraints[0].parameters
    return {"center": list(parameters["center"].value), "radius": float(parameters["radius"].value)}


def test_goal_of_a_crowd_is_drawn_where_it_is(browser: Browser) -> None:
    """What stands still in a crowd is drawn once; what changed must be drawn anew."""
    agents = [cs.Agent(f"q{i}", [cs.within([4 * (i % 5), 4 * (i // 5)], 1, name="goal")], [4 * (i % 5), 4 * (i // 5)]) for i in range(15)]
    with cs.live(cs.Team(agents, [(f"q{i}", f"q{i + 1}") for i in range(14)]), seed=1, port=0, open_page=False, block=False) as live:
        for tab in opened(browser, live.url):
            for name in ("paths", "links"):
                tab.get_by_label(name).uncheck()
            until(tab, "consat.margin > 0.9")
            x, y = tab.evaluate("consat.where('q7')")

            def tinted(dx: float, tab: Tab = tab, x: float = x, y: float = y) -> bool:
                """Whether the ground is, below the agent and in its goal."""
                shot = Image.open(io.BytesIO(tab.screenshot())).convert("RGB")
                return shot.getpixel((x + dx + 5, y + 25)) != (255, 255, 255)

            assert [tinted(0), tinted(60)] == [True, False]
            drag(tab, tab.evaluate("consat.handle('q7', 'goal')"), (60, 0))
            tab.mouse.move(10, 300)
            settle(lambda: [tinted(0), tinted(60)] == [False, True])
            tab.keyboard.press("z")
            settle(lambda: [tinted(0), tinted(60)] == [True, False])


def settle(holds: Callable[[], Any]) -> None:
    end = time.monotonic() + 20.0
    while not holds():
        assert time.monotonic() < end
        time.sleep(0.1)


def test_page_reconnects_when_the_server_is_there_again(browser: Browser) -> None:
    first = cs.live("case-b", seed=1, port=0, open_page=False, block=False)
    port = int(first.url.rstrip("/").rpartition(":")[2])
    pages = opened(browser, first.url)
    tab = next(pages)
    first.close()
    tab.locator("[data-part=note].bad").wait_for()
    assert "the connection to the session is gone" in tab.locator("[data-part=note]").inner_text()
    with cs.live("case-b", seed=2, port=port, open_page=False, block=False):
        tab.locator("[data-part=note].bad").wait_for(state="hidden")
        until(tab, "consat.margin > 0.9")
    for _ in pages:
        pass


MODEL = """async ([code, page]) => {
    const { default: widget } = await import(URL.createObjectURL(new Blob([code], { type: "text/javascript" })));
    let heard = null;
    const model = {
        get: (name) => ({ page, height: 560 })[name], send: (content) => kernel(content), on: (_, hear) => { heard = hear; }, off() {},
    };
    window.hear = (content, buffers) => heard(content, buffers.map((text) => {
        const bytes = Uint8Array.from(`--------${atob(text)}`, (each) => each.charCodeAt(0));  // a view into more, as notebooks have it
        return new DataView(bytes.buffer, 8);
    }));
    window.close_ = widget.render({ model, el: document.body });
}"""


def test_widget_shows_the_team_and_a_mouse_drags_its_goal(browser: Browser, monkeypatch: pytest.MonkeyPatch) -> None:
    """The notebook is this test: it carries the messages between the widget's two halves."""
    with cs.live("case-b", widget=True, seed=1) as shown:
        monkeypatch.setattr(type(shown), "comm", Comm())
        context = browser.new_context(viewport={"width": 1280, "height": 800})
        tab = context.new_page()
        tab.expose_function("kernel", lambda content: shown._handle_msg(message(content)))
        tab.evaluate(MODEL, [shown._esm, shown.page])
        read = 0

        def until_framed(holds: str) -> Any:
            nonlocal read
            end = time.monotonic() + 60.0
            while time.monotonic() < end:
                for content, buffers in shown.comm.sent[read:]:
                    read += 1
                    tab.evaluate(
                        "([content, buffers]) => hear(content, buffers)", [content, [b64encode(each).decode() for each in buffers]]
                    )
                if found := tab.frames[-1].evaluate(f"window.consat && ({holds})"):
                    return found
                tab.wait_for_timeout(20)
            raise AssertionError(holds)

        before = until_framed("consat.margin > 0.95 && consat.where('a1')")
        box = tab.locator("iframe").bounding_box()
        x, y = tab.frames[-1].evaluate("consat.handle('a1', 'goal')")
        drag(tab, [box["x"] + x, box["y"] + y], (40, -40))
        until_framed(f"consat.where('a1')[0] > {before[0] + 20} && consat.where('a1')[1] < {before[1] - 20}")
        tab.evaluate("close_()")
        end = time.monotonic() + 10.0
        while shown._watchers:
            assert time.monotonic() < end
            tab.wait_for_timeout(20)
        context.close()


def test_replay_opens_from_disk_with_the_network_off(browser: Browser, tmp_path: Path) -> None:
    page = cs.run("case-b", rounds=30).html(tmp_path / "run.html")
    context = browser.new_context(offline=True)
    tab, said = context.new_page(), list[str]()
    tab.on("pageerror", lambda error: said.append(str(error)))
    tab.on("request", lambda request: said.append(request.url) if not request.url.startswith("file:") else None)
    tab.goto(page.resolve().as_uri())
    until(tab, "consat.round >= 29.9")
    assert tab.evaluate("consat.agents()") == ["a1", "a2", "a3"]
    context.close()
    assert not said
