"""Bring every generated file up to date: ``python -m docs.generate``."""

from __future__ import annotations

from docs.generate.marks import DOCS, PICTURE, ROOT, by_hand, pages, with_parts
from docs.generate.picture import node_picture
from docs.generate.ros import parameter_file


def main() -> None:
    """Rewrite the parts of README and pages, the picture, and the nodes' parameter file."""
    wanted = {path: with_parts(path.read_text(encoding="utf-8")) for path in pages()}
    wanted[ROOT / "launch_scripts" / "slamfusion.yaml"] = parameter_file()
    wanted[PICTURE] = node_picture()
    for path, text in wanted.items():
        if not path.is_file() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")
            print(f"wrote {path.relative_to(ROOT)}")
    own = [
        text for path, text in wanted.items() if path.suffix == ".md" and path.is_relative_to(DOCS)
    ]
    own.append(wanted[ROOT / "README.md"])
    print(f"{sum(len(by_hand(text).split()) for text in own)} words by hand in README and docs")


if __name__ == "__main__":
    main()
