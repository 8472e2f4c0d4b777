"""The front end as one script, and the parts of HTML that pages share."""

from __future__ import annotations

import re

import pytest

from slamfusion.viewer import front

pytestmark = pytest.mark.once


def test_a_bundle_has_each_module_once_after_those_that_it_needs() -> None:
    text = front.bundled('import { Stage, byId } from "./stage.js";\nnew Stage();\n')
    order = re.findall(r"^const from_(\w+) = \(\(\) => \{$", text, re.MULTILINE)
    assert sorted(order) == ["maps", "panels", "stage", "view"]
    assert order.index("maps") < order.index("view")
    assert order[-1] == "stage"
    assert "const { Stage, byId } = from_stage;\nnew Stage();\n" in text
    assert "return { Maps, Raster" not in text  # in the order in which they are declared
    assert re.search(
        r"^return \{ Raster, Maps, css, isWall, isKnown, said \};$", text, re.MULTILINE
    )
    assert not re.search(r"^\s*(import|export)\b", text, re.MULTILINE)
    assert "</script" not in text


@pytest.mark.parametrize(
    "line",
    [
        'import * as maps from "./maps.js";',
        'import { Maps as M } from "./maps.js";',
        'import "./maps.js";',
        "export default 3;",
    ],
)
def test_a_form_that_the_bundle_would_break_is_refused(line: str) -> None:
    with pytest.raises(ValueError, match="cannot be bundled"):
        front.bundled(f"{line}\n")


def test_every_module_can_be_bundled() -> None:
    names = [name.removesuffix(".js") for name in front.front_end() if name.endswith(".js")]
    assert len(names) == 5
    for name in names:
        assert f"const from_{name} = " in front.bundled(f'import {{ a }} from "./{name}.js";\n')


def test_fragments_take_their_places() -> None:
    html = front.with_fragments("<main>\n<!-- stage.html -->\n</main>")
    assert html.startswith('<main>\n<canvas id="map"')
    with pytest.raises(KeyError):
        front.with_fragments("<!-- none.html -->")
