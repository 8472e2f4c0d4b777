"""The front end as one script, and the parts of HTML that pages share."""

from __future__ import annotations

import re

from slamfusion import web


def test_a_bundle_has_each_module_before_those_that_need_it() -> None:
    text = web.bundled('import { Stage, byId } from "./stage.js";\nnew Stage();\n')
    order = [text.index(f"\nclass {name} ") for name in ("Maps", "Layers", "View", "Stage")]
    assert order == sorted(order)
    assert text.endswith("\nnew Stage();\n")
    assert not re.search(r"^\s*(import|export)\b", text, re.MULTILINE)
    assert "</script" not in text


def test_modules_of_a_bundle_share_no_name_and_import_no_other() -> None:
    files = web.front_end()
    whole = "".join(files[name] for name in web.VIEWER)
    names = re.findall(
        r"^(?:export )?(?:async )?(?:class|const|let|function) (\w+)", whole, re.MULTILINE
    )
    assert len(names) > 20
    assert len(names) == len(set(names))
    imported = set(re.findall(r'^import .* from "\./(.*)";$', whole, re.MULTILINE))
    assert imported < set(web.VIEWER)


def test_fragments_take_their_places() -> None:
    html = web.front_end()["index.html"]
    assert '<canvas id="map"' in html
    assert "<!--" not in html
