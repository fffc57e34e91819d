"""Writes the site of the documentation: python docs/make_site.py, or ./drax docs.

The pages of docs/ refer to files of the checkout (README, CONTRIBUTING, notebooks, code), as a
forge shows them. Here they are copied into out/docs-source with links that work on the site, and
notebooks become pages, beside two pages that are written from the code: the reference and the
gallery. mkdocs, which mkdocs.yml sets up, makes HTML of them in out/docs.
"""

import ast
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import griffe

import mjx_drax
from mjx_drax import tasks

ROOT = Path(__file__).parents[1]
PAGES = [
    *sorted((ROOT / "docs").glob("*.md")),
    *(ROOT / name for name in ("CONTRIBUTING.md", "CHANGELOG.md")),
]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
FROM_ROOMS = (
    "view.plotting.plot_optima",
    "view.phase_plots.plot_phase",
    "view.phase_plots.plot_multipliers",
    "view.browser.viewer.show",
    "view.browser.viewer.live_page",
)
WORKER = """\
// Browsers refuse workers to pages from disk. There the search runs in a hidden frame.
if (location.protocol === "file:") window.Worker = class extends EventTarget {
  constructor(url) {
    super()
    const frame = document.body.appendChild(document.createElement("iframe"))
    frame.hidden = true
    const there = this.there = frame.contentWindow
    const load = src => new Promise((onload, onerror) => there.document.body.append(
      Object.assign(there.document.createElement("script"), { src, onload, onerror })))
    there.importScripts = async (...urls) => { for (const each of urls) await load(each) }
    there.postMessage = data => this.dispatchEvent(new MessageEvent("message", { data }))
    this.loaded = load(url)
  }
  async postMessage(data) {
    await this.loaded
    this.there.dispatchEvent(new MessageEvent("message", { data }))
  }
}
"""


class Examples(griffe.Extension):
    """Examples in docstrings become code: Markdown takes >>> for quotations."""

    def on_object(self, *, obj: griffe.Object, **_: object) -> None:
        """Rewrite its docstring."""
        if obj.docstring:
            obj.docstring.value = re.sub(
                r"^>>> .*(\n(>>>|\.\.\.) .*)*",
                lambda lines: f"```python\n{re.sub(r'(?m)^(>>>|[.]{3}) ', '', lines[0])}\n```",
                obj.docstring.value,
                flags=re.MULTILINE,
            )


def write(source: Path) -> None:
    """All pages, as mkdocs reads them."""
    shutil.rmtree(source, ignore_errors=True)
    source.mkdir(parents=True)
    for page in PAGES:
        (source / page.name).write_text(linked(page.read_text("utf-8")), encoding="utf-8")
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    (source / "index.md").write_text(linked(readme), encoding="utf-8")
    (source / "notebooks").mkdir()
    for path in NOTEBOOKS:
        page = source / "notebooks" / f"{path.stem}.md"
        page.write_text(notebook(path), encoding="utf-8")
    (source / "iframe-worker.js").write_text(WORKER, encoding="utf-8")
    (source / "reference.md").write_text(reference(), encoding="utf-8")
    (source / "gallery.md").write_text(gallery(), encoding="utf-8")
    for picture in (ROOT / "docs").rglob("*.webp"):
        target = source / picture.relative_to(ROOT / "docs")
        target.parent.mkdir(exist_ok=True)
        shutil.copy(picture, target)


def linked(text: str, top: str = "") -> str:
    """A page whose links to files that are not on the site are words only; `top` leads to index."""
    known = {page.name: page.name for page in PAGES} | {"README.md": "index.md"}
    known |= {path.name: f"notebooks/{path.stem}.md" for path in NOTEBOOKS}

    def changed(match: re.Match[str]) -> str:
        text, target, anchor = match.groups()
        name = Path(target).name
        if "://" in target or target == "":
            return match[0]
        if name.endswith(".webp"):
            return f"[{text}]({top}{name})"
        if name in known:
            return f"[{text}]({top}{known[name]}{anchor or ''})"
        return text if text.startswith("`") else f"`{target.removeprefix('../')}`"

    return re.sub(r"\[([^\]]*)\]\(([^)#]*)(#[^)]*)?\)", changed, text)


def notebook(path: Path) -> str:
    """A notebook as a page, with the outputs that it has."""
    lines = []
    for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
        text = "".join(cell["source"])
        code = cell["cell_type"] == "code"
        lines += [f"```python\n{text}\n```" if code else linked(text, "../"), ""]
        for output in cell.get("outputs", []):
            if "text" in output:
                lines += ["```text", "".join(output["text"]).rstrip(), "```", ""]
            else:
                png = "".join(output["data"]["image/png"]).replace("\n", "")
                lines += [f"![A figure](data:image/png;base64,{png})", ""]
    return "\n".join(lines)


def reference() -> str:
    """Every public name, in the order of `mjx_drax.__all__`, and those to import from rooms."""
    lines = ["# Reference", "", "All public names of `mjx_drax`, from their docstrings.", ""]
    for name in mjx_drax.__all__:
        value = getattr(mjx_drax, name)
        if hasattr(value, "__module__"):
            lines += [f"::: {value.__module__}.{name}", ""]
    for module in ("guesses", "obstacles"):
        lines += [f"::: {getattr(mjx_drax, module).__name__}", ""]
    lines += ["Imported from the modules that stand before their names:", ""]
    for name in FROM_ROOMS:
        lines += [f"::: mjx_drax.{name}", "    options: { show_root_full_path: true }", ""]
    return "\n".join(lines)


def gallery() -> str:
    """Every task: its film and poster, how to solve it, and the function that states it."""
    lines = [
        "# Gallery",
        "",
        "All tasks of `mjx-drax list`. Films and pictures show the replay of an answer; two films",
        "show before how knots became it. Films of short motions are in slow motion, those of long",
        "ones faster: t is the motion's time. Of the poses in a picture the fainter are earlier.",
        "Each task is a file that states a problem. Here are its function `make` and what that",
        "takes of other tasks; the functions of the cost are in the file. The command writes a",
        "video, a film, pictures and plots into `out/TASK`.",
        "",
    ]
    for name in tasks.names():
        pictures = f"{name}.webp", f"posters/{name}.webp"  # the film, and the poster
        shown = [picture for picture in pictures if (ROOT / "docs" / picture).exists()]
        lines += [f"## {name}", "", tasks.summary(name), ""]
        lines += [" ".join(f"![{name}]({picture}){{ width=49% }}" for picture in shown), ""]
        lines += ["```sh", f"mjx-drax solve {name} --film", "```", ""]
        others = re.findall(rf"\b({'|'.join(tasks.names())})\.(\w+)", stated(name, "make"))
        for task, part in [(name, "make"), *others]:
            lines += [f'```python title="tasks/{task}.py"', stated(task, part), "```", ""]
    return "\n".join(lines)


def stated(task: str, name: str) -> str:
    """A task's function or constant, and the constants that it names."""
    text = (ROOT / "tasks" / f"{task}.py").read_text(encoding="utf-8")
    parts: dict[str, ast.stmt] = {}
    for node in ast.parse(text).body:
        if isinstance(node, ast.Assign):
            parts[ast.unparse(node.targets[0])] = node
        elif isinstance(node, ast.FunctionDef):
            parts[node.name] = node
    names = {node.id for node in ast.walk(parts[name]) if isinstance(node, ast.Name)}
    lines: list[str] = []
    for other, node in parts.items():
        if other == name or (other in names and isinstance(node, ast.Assign)):
            lines += [""] * (lines != [] and isinstance(node, ast.FunctionDef))
            lines += text.splitlines()[node.lineno - 1 : node.end_lineno]
    return "\n".join(lines)


if __name__ == "__main__":
    write(ROOT / "out" / "docs-source")
    command = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--strict"]
    status = subprocess.run(command, cwd=ROOT, check=False).returncode
    if status == 0:
        print(ROOT / "out" / "docs" / "index.html")
    sys.exit(status)
