"""Writes the site of the documentation: python docs/make_site.py, or ./drax docs.

The pages of docs/ refer to files of the checkout (README, CONTRIBUTING, notebooks, code), as a
forge shows them. Here they are copied into out/docs-source with links that work on the site, beside
two pages that are written from the code: the reference and the gallery. mkdocs, which mkdocs.yml
sets up, makes HTML of them in out/docs.
"""

import ast
import re
import shutil
import subprocess
import sys
from pathlib import Path

import mjx_drax
from mjx_drax import tasks

ROOT = Path(__file__).parents[1]
PAGES = [
    *sorted((ROOT / "docs").glob("*.md")),
    *(ROOT / name for name in ("CONTRIBUTING.md", "CHANGELOG.md")),
]


def write(source: Path) -> None:
    """All pages, as mkdocs reads them."""
    shutil.rmtree(source, ignore_errors=True)
    source.mkdir(parents=True)
    for page in PAGES:
        (source / page.name).write_text(linked(page), encoding="utf-8")
    (source / "index.md").write_text(linked(ROOT / "README.md"), encoding="utf-8")
    (source / "reference.md").write_text(reference(), encoding="utf-8")
    (source / "gallery.md").write_text(gallery(), encoding="utf-8")
    for picture in (ROOT / "docs").rglob("*.webp"):
        target = source / picture.relative_to(ROOT / "docs")
        target.parent.mkdir(exist_ok=True)
        shutil.copy(picture, target)


def linked(page: Path) -> str:
    """A page whose links to files that are not on the site are words only."""
    known = {page.name for page in PAGES} | {"README.md"}

    def changed(match: re.Match[str]) -> str:
        text, target, anchor = match.groups()
        name = Path(target).name
        if "://" in target or target == "":
            return match[0]
        if name.endswith(".webp"):
            return f"[{text}]({name})"
        if name in known:
            return f"[{text}]({'index.md' if name == 'README.md' else name}{anchor or ''})"
        return text if text.startswith("`") else f"`{target.removeprefix('../')}`"

    text = page.read_text(encoding="utf-8")
    return re.sub(r"\[([^\]]*)\]\(([^)#]*)(#[^)]*)?\)", changed, text)


def reference() -> str:
    """Every public name, in the order of `mjx_drax.__all__`."""
    lines = ["# Reference", "", "All public names of `mjx_drax`, from their docstrings.", ""]
    for name in mjx_drax.__all__:
        value = getattr(mjx_drax, name)
        if hasattr(value, "__module__"):
            lines += [f"::: {value.__module__}.{name}", ""]
    for module in ("guesses", "obstacles"):
        lines += [f"::: {getattr(mjx_drax, module).__name__}", ""]
    return "\n".join(lines)


def gallery() -> str:
    """Every task: its poster, how to solve it, and the code that states it."""
    lines = [
        "# Gallery",
        "",
        "All tasks of `mjx-drax list`. A picture shows the replay of an answer; of its poses the",
        "fainter are earlier. Each task is a file that states a problem; the code is its function",
        "`make`. The command writes a video, a film, pictures and plots into `out/TASK`.",
        "",
    ]
    for name in tasks.names():
        file = ROOT / "tasks" / f"{name}.py"
        text = file.read_text(encoding="utf-8")
        make = next(node for node in ast.parse(text).body if getattr(node, "name", "") == "make")
        pictures = [
            f"{name}.webp",
            f"posters/{name}.webp",
        ]  # a film, if there is one, and the poster
        shown = [picture for picture in pictures if (ROOT / "docs" / picture).exists()]
        lines += [f"## {name}", "", tasks.summary(name), ""]
        lines += [" ".join(f"![{name}]({picture}){{ width=400 }}" for picture in shown), ""]
        lines += ["```sh", f"mjx-drax solve {name} --film", "```", ""]
        lines += ["```python", ast.get_source_segment(text, make) or "", "```", ""]
    return "\n".join(lines)


if __name__ == "__main__":
    write(ROOT / "out" / "docs-source")
    command = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--strict"]
    status = subprocess.run(command, cwd=ROOT, check=False).returncode
    if status == 0:
        print(ROOT / "out" / "docs" / "index.html")
    sys.exit(status)
