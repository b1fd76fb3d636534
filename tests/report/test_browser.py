"""Pages in a real browser: nothing is cut off or overlaps, no error, zoom and legends work."""

import shutil

import pytest

from browser import CHROMIUM, Browser

pytest.importorskip("websockets.sync.client")
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here")

DRAW_ALL = """(async () => {
  document.querySelectorAll("details").forEach((part) => { part.open = true; });
  for (const chart of document.querySelectorAll(".chart")) {
    chart.scrollIntoView({ behavior: "instant" });
    for (let k = 0; k < 200 && !chart.classList.contains("drawn"); k++)
      await new Promise((next) => setTimeout(next, 20));
  }
  scrollTo({ top: 0, behavior: "instant" });
  await new Promise((next) => setTimeout(next, 300));
  return document.querySelectorAll(".chart:not(.drawn)").length;
})()"""

FAULTS = """(() => {
  const faults = [], width = document.documentElement.clientWidth;
  if (document.documentElement.scrollWidth > width) faults.push("the page scrolls sideways");
  const visible = (x) => x.width > 0 && x.height > 0;
  const texts = document.querySelectorAll("h1, h2, p, dt, dd, li, summary, button, figcaption, .tiles b");
  for (const text of texts) {
    const box = text.getBoundingClientRect();
    if (!visible(box) || text.closest(".scroll")) continue;
    if (box.left < -0.5 || box.right > width + 0.5 || text.scrollWidth > text.clientWidth + 1 && text.clientWidth)
      faults.push(`cut off: ${text.textContent.trim().slice(0, 40)}`);
  }
  for (const chart of document.querySelectorAll(".chart.drawn")) {
    const frame = chart.getBoundingClientRect();
    const own = [...chart.querySelectorAll(".xtick text, .ytick text, .xtitle, .ytitle, .y2title")];
    const boxes = own.map((text) => [text.textContent, text.getBoundingClientRect()]);
    for (const [text, box] of boxes)
      if (visible(box) && (box.left < frame.left - 1 || box.right > frame.right + 1 || box.top < frame.top - 1 || box.bottom > frame.bottom + 1))
        faults.push(`cut off in ${chart.ariaLabel}: ${text}`);
    for (let i = 0; i < boxes.length; i++)
      for (let k = i + 1; k < boxes.length; k++) {
        const [a, b] = [boxes[i][1], boxes[k][1]];
        const across = Math.min(a.right, b.right) - Math.max(a.left, b.left);
        const down = Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top);
        if (across > 2 && down > 3) faults.push(`overlap in ${chart.ariaLabel}: ${boxes[i][0]} and ${boxes[k][0]}`);
      }
  }
  return faults;
})()"""


@pytest.fixture(scope="module")
def browser():
    browser = Browser()
    yield browser
    browser.close()


@pytest.fixture(scope="module")
def pages(written, changed, tmp_path_factory):
    """An identification, and a comparison."""
    from jaxid.report.result_files import write_comparison

    folder = tmp_path_factory.mktemp("comparison") / "out"
    page, *_ = write_comparison(folder, changed)
    return {"identification": written / "report.html", "comparison": page}


@pytest.mark.parametrize("name", ["identification", "comparison"])
@pytest.mark.parametrize("width", [390, 768, 1280])
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_nothing_is_cut_off(browser, pages, name, width, scheme):
    browser.errors.clear()
    browser.look(width, scheme)
    browser.open(pages[name])
    assert browser.evaluate(DRAW_ALL) == 0
    assert browser.evaluate(FAULTS) == []
    assert browser.errors == []


def test_dark_pages_are_dark(browser, pages):
    ink = "getComputedStyle(document.querySelector('.xtick text')).fill"
    seen = []
    for scheme in ("light", "dark"):
        browser.look(1280, scheme)
        browser.open(pages["comparison"])
        browser.evaluate(DRAW_ALL)
        ground = browser.evaluate("getComputedStyle(document.body).backgroundColor")
        seen.append((browser.evaluate(ink), sum(map(int, ground[4:-1].split(","))) > 382))
    assert [light for _, light in seen] == [True, False]
    assert seen[0][0] != seen[1][0]


def test_zooming_one_joint_with_the_mouse_zooms_all(browser, pages):
    browser.look(1280)
    browser.open(pages["identification"])
    browser.evaluate(DRAW_ALL)
    charts = "[...[...document.querySelectorAll('figure')].find((f) => f.querySelector('[data-curve=measured]')).querySelectorAll('.chart')]"
    ranges = f"{charts}.map((chart) => chart.layout.xaxis.range.map(Number))"
    first, second = browser.evaluate(ranges)
    assert first == second
    place = f"""(() => {{ const box = {charts}[0].querySelector('.nsewdrag');
      box.scrollIntoView({{ behavior: "instant", block: "center" }});
      const {{ x, y, width, height }} = box.getBoundingClientRect();
      return [x + 0.25 * width, x + 0.75 * width, y + 0.5 * height]; }})()"""
    left, right, height = browser.evaluate(place)
    for kind, x in (("Moved", left), ("Pressed", left), ("Moved", right), ("Released", right)):
        button = "none" if kind == "Moved" and x == left else "left"
        event = {"type": f"mouse{kind}", "x": x, "y": height, "button": button, "clickCount": 1}
        browser.call("Input.dispatchMouseEvent", **event)
    middle = [0.75 * first[0] + 0.25 * first[1], 0.25 * first[0] + 0.75 * first[1]]
    browser.wait(f"{ranges}.every((range) => range[0] > {first[0]} && range[1] < {first[1]})")
    for zoomed in browser.evaluate(ranges):
        assert zoomed == pytest.approx(middle, abs=0.02)


def test_legends_switch_curves_and_joints_off_and_on(browser, pages):
    browser.look(1280)
    browser.open(pages["identification"])
    browser.evaluate(DRAW_ALL)
    figure = "[...document.querySelectorAll('figure')].find((f) => f.querySelector('[data-curve=measured]'))"
    shown = f"[...{figure}.querySelectorAll('.chart')].map((c) => c.data.filter((t) => t.visible !== false).length)"
    press = f"{figure}.querySelector('[data-curve=measured]').click()"
    assert browser.evaluate(shown) == [3, 3]
    browser.evaluate(press)
    assert browser.evaluate(shown) == [2, 2]
    browser.evaluate(press)
    assert browser.evaluate(shown) == [3, 3]


def test_the_robot_moves_with_the_slider(browser, pages):
    browser.look(1280)
    browser.open(pages["identification"])
    browser.evaluate(DRAW_ALL)
    robot = "[...document.querySelectorAll('.chart')].find((chart) => chart.content.frames)"
    browser.wait(f"!!{robot}.parentNode.querySelector('.player output').textContent")
    place = f"JSON.stringify({robot}.data[1].x)"
    before = browser.evaluate(place)
    browser.evaluate(
        f"(() => {{ const s = {robot}.parentNode.querySelector('input'); s.value = 70; s.dispatchEvent(new Event('input')); }})()"
    )
    assert browser.evaluate(place) != before


def test_paper_has_every_figure_and_what_was_folded(browser, pages, tmp_path):
    browser.look(1280)
    browser.open(pages["identification"])
    browser.errors.clear()
    browser.pdf(tmp_path / "page.pdf")
    browser.wait("document.querySelectorAll('.chart:not(.drawn)').length === 0")
    assert browser.errors == []
    assert (tmp_path / "page.pdf").stat().st_size > 100_000
    # After printing the page is as it was.
    assert browser.evaluate("document.querySelectorAll('details[open]').length") == 0
    if shutil.which("pdftotext"):
        import subprocess

        text = subprocess.run(["pdftotext", "-layout", tmp_path / "page.pdf", "-"], capture_output=True, text=True, check=True).stdout
        assert "Residuals" in text
        assert "frequency [Hz]" in text
