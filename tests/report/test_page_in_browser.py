"""The page as a browser has it: what choosing does, that it fits a phone, and that axe-core finds nothing wrong."""

import numpy as np
import pytest
from browser import needed, run_in_page, violations
from test_html import report as gathered  # noqa: F401  the fixture, under a name that no argument hides

from derender.batch.ledger import index_page
from derender.report.html import page
from derender.results.table import failed_row, rows_of
from derender.results.trust import Doubt, Region


@pytest.fixture(scope="module")
def text(gathered):  # noqa: F811
    mask = np.zeros((60, 80), bool)
    mask[30:40, 5:20] = True
    doubts = (Doubt("3 % of the image is not explained: region A", True, (Region("A", mask, 0.03),)),)
    return page(gathered._replace(doubts=doubts, files={"scene.yaml": ("text/yaml", b"derender: 1\n")}))


def many_frames(folder):
    """Return the page of many frames: one that is trusted, one that is not, one that failed."""
    box = {"name": "box_1", "type": "box", "size": [0.1, 0.2, 0.3], "pose": np.eye(4).tolist(), "parent": "floor"}
    rows = {"bad": [failed_row("bad", "no image at all")]}
    for name, trusted in (("fine", True), ("doubtful", False)):
        told = {"trusted": trusted, "doubts": [] if trusted else ["the chains disagree"]}
        scene = {"objects": [box], "gravity": [0.0, 1.0, 0.0]}
        rows[name] = rows_of(name, {"scene": scene, **told})
    return index_page(folder, rows)


@pytest.mark.parametrize("dark", [False, True], ids=["light", "dark"])
@pytest.mark.parametrize("of", ["one image", "many frames"])
def test_axe_finds_no_violation(text, tmp_path, of, dark):
    needed(axe=True)
    assert violations(text if of == "one image" else many_frames(tmp_path), tmp_path, dark) == []


def test_choosing_an_object_marks_it_everywhere(text, tmp_path):
    needed()
    script = """
      const marked = () => [...document.querySelectorAll(".chosen")].map(e => e.tagName.toLowerCase()).sort();
      const view = []; document.getElementById("scene").addEventListener("choose", e => view.push(e.detail));
      document.querySelector("td button[data-object=can]").click();
      const clicked = marked();
      const area = document.querySelector("svg.marks g[data-object=cube] .area");
      area.dispatchEvent(new MouseEvent("click", {bubbles: true}));
      const other = [...document.querySelectorAll(".chosen")].map(e => e.dataset.object);
      const node = document.querySelector("svg g[role=button][data-object=ball]");
      node.dispatchEvent(new KeyboardEvent("keydown", {key: "Enter", bubbles: true}));
      const pressed = [...document.querySelectorAll("[aria-pressed=true]")].map(e => e.dataset.object);
      document.dispatchEvent(new KeyboardEvent("keydown", {key: "Escape"}));
      return {clicked, other, pressed, left: marked(), view};"""
    told = run_in_page(text, script, tmp_path)
    assert (
        set(told["clicked"]) == {"button", "g", "tr"} and told["clicked"].count("g") >= 4
    )  # three pictures, the graph
    assert set(told["other"]) == {"cube"} and set(told["pressed"]) == {"ball"}
    assert told["left"] == [] and told["view"] == ["can", "cube", "ball", None]


@pytest.mark.parametrize("width", [390, *(pytest.param(width, marks=pytest.mark.slow) for width in (768, 1280))])
def test_the_page_is_no_wider_than_its_window(text, tmp_path, width):
    """Chromium's window is never narrower than 500 pixels, a frame's is; what is wider inside says that it goes on."""
    needed()
    script = """
      const frame = document.createElement("iframe");
      frame.style.cssText = "border:0;height:900px;width:" + WIDTH + "px";
      const loaded = new Promise(done => frame.onload = done);
      const copy = document.documentElement.cloneNode(true);
      copy.querySelector("#asked").remove();
      frame.srcdoc = copy.outerHTML;
      document.body.append(frame); await loaded;
      const inner = frame.contentDocument, tables = [...inner.querySelectorAll(".scroll")];
      const view = getComputedStyle(inner.getElementById("scene"));
      const over = [...inner.querySelectorAll("body *")].filter(e => !e.closest(".scroll, svg.marks")
        && e.getBoundingClientRect().right > WIDTH + 1).map(e => e.outerHTML.slice(0, 80));
      return {over, wide: inner.documentElement.scrollWidth, touch: view.touchAction,
              told: tables.every(t => (t.scrollWidth - t.clientWidth > 2) === !t.nextElementSibling.hidden),
              some: tables.some(t => t.scrollWidth - t.clientWidth > 2)};""".replace("WIDTH", str(width))
    told = run_in_page(text, script, tmp_path, width=1400)
    assert told["over"] == [] and told["wide"] <= width and told["told"] and told["touch"] == "pan-y"
    assert told["some"] or width > 390


@pytest.mark.parametrize("width", [768, 1280])
def test_pictures_of_a_row_and_of_the_next_are_as_wide(text, tmp_path, width):
    needed()
    script = """
      const row = [...document.querySelectorAll(".pictures")].find(e => e.children.length > 2);
      return [...row.children].map(e => Math.round(e.getBoundingClientRect().width));"""
    told = run_in_page(text, script, tmp_path, width=width)
    assert len(told) >= 3 and len(set(told)) == 1


def test_many_frames_are_cards_on_a_phone(tmp_path):
    needed()
    script = """
      const frame = document.createElement("iframe");
      frame.style.cssText = "border:0;height:900px;width:390px";
      const loaded = new Promise(done => frame.onload = done);
      const copy = document.documentElement.cloneNode(true);
      copy.querySelector("#asked").remove();
      frame.srcdoc = copy.outerHTML;
      document.body.append(frame); await loaded;
      const inner = frame.contentDocument;
      inner.querySelector("input[value=failed]").click();
      return {wide: Math.max(...[...inner.querySelectorAll("body *")].map(e => e.getBoundingClientRect().right)),
              shown: [...inner.querySelectorAll("tbody tr")].filter(e => e.offsetHeight > 0).length};"""
    told = run_in_page(many_frames(tmp_path), script, tmp_path, width=1400)
    assert told["wide"] <= 390 and told["shown"] == 1
