"""The pages in `docs/`: each public name on one of them, each example of the reference runs, each link leads on."""

import doctest
import importlib
import importlib.util
import inspect
import re
from collections import Counter
from pathlib import Path

import matplotlib
import pytest

import ehsvjax

# The pages share their bench, and what is compiled for it.
pytestmark = pytest.mark.xdist_group("documentation")

ROOT = Path(__file__).parents[1]
PAGES = sorted((ROOT / "docs").rglob("*.md"))
REFERENCE = [page for page in PAGES if page.parent.name == "reference" and page.name != "index.md"]
# Pages that are made when the documentation is: the gallery, and the notebooks as they are.
MADE = re.compile(r"gallery/index\.md|notebooks/\w+\.(ipynb|png)")
OPTIONS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE


def name_of(page):
    return str(page.relative_to(ROOT / "docs"))


def documented(page):
    """Dotted names that a page has from their docstrings."""
    return re.findall(r"^\.\. auto(?:class|function|data):: (\S+)$", page.read_text(), re.MULTILINE)


def found(name):
    """What a dotted name stands for, whatever module it is reached through."""
    module, _, last = name.rpartition(".")
    return getattr(importlib.import_module(module), last)


def examples_of(page):
    return "\n".join(re.findall(r"```pycon\n(.*?)```", page.read_text(), re.DOTALL))


def public_names():
    """Every name of the package's face, and of the modules that are part of it."""
    names = []
    for name in ehsvjax.__all__:
        value = getattr(ehsvjax, name)
        if not inspect.ismodule(value):
            names.append(f"ehsvjax.{name}")
            continue
        of_module = getattr(value, "__all__", None) or [
            label for label, one in vars(value).items()
            if not label.startswith("_") and inspect.isfunction(one) and one.__module__ == value.__name__
        ]  # fmt: skip
        names += [f"ehsvjax.{name}.{label}" for label in of_module if getattr(ehsvjax, label, None) is None]
    return names


@pytest.mark.parametrize("name", public_names())
def test_every_public_name_is_on_one_page_with_an_example(name):
    pages = [page for page in REFERENCE if any(found(one) is found(name) for one in documented(page))]
    assert len(pages) == 1, [name_of(page) for page in pages]
    assert re.search(rf"\b{name.rpartition('.')[2]}\b", examples_of(pages[0]))


def test_nothing_is_documented_twice():
    counts = Counter(name for page in PAGES for name in documented(page))
    assert [name for name, count in counts.items() if count > 1] == []


@pytest.fixture(scope="module")
def bench():
    """What the examples of the reference share."""
    matplotlib.use("Agg")
    names: dict = {}
    run(ROOT / "docs" / "reference" / "index.md", names)
    return names


def run(page, names):
    """Run the examples of a page from the top down."""
    test = doctest.DocTestParser().get_doctest(examples_of(page), names, name_of(page), str(page), 0)
    runner, said = doctest.DocTestRunner(optionflags=OPTIONS), []
    runner.run(test, out=said.append, clear_globs=False)
    names.update(test.globs)
    assert not runner.summarize(verbose=False).failed, "".join(said)


@pytest.mark.parametrize("page", REFERENCE, ids=name_of)
def test_examples_run(page, bench):
    run(page, dict(bench))


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_code_can_be_read(page):
    for block in re.findall(r"```(?:python|\{code-cell\})\n(?::[^\n]*\n)*(.*?)```", page.read_text(), re.DOTALL):
        compile(block, name_of(page), "exec")


def anchors(page):
    """Headings of a page as MyST names them."""
    headings = re.findall(r"^#{1,3} (.+)$", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_links_lead_somewhere(page):
    for link in re.findall(r"\]\(([^)\s]+)\)|\{(?:include|figure|image)\} (\S+)", page.read_text()):
        path, _, anchor = "".join(link).partition("#")
        if path.startswith("https://"):
            continue
        target = (page.parent / path).resolve() if path else page
        inside = str(target.relative_to(ROOT / "docs")) if target.is_relative_to(ROOT / "docs") else ""
        if MADE.fullmatch(inside):
            target = ROOT / inside
            assert inside == "gallery/index.md" or target.exists(), link
        else:
            assert target.exists(), link
            assert not anchor or anchor in anchors(target), link


def test_every_page_is_in_a_table_of_contents():
    listed = {(page.parent / line).resolve() for page in PAGES for line in contents_of(page)}
    for page in PAGES:
        assert page.with_suffix("") in listed or page == ROOT / "docs" / "index.md", name_of(page)


def contents_of(page):
    """Entries of a page's tables of contents."""
    tables = re.findall(r"```\{toctree\}\n(.*?)```", page.read_text(), re.DOTALL)
    return [line for table in tables for line in table.splitlines() if line and not line.startswith(":")]


def test_every_effect_of_the_bank_is_in_the_gallery():
    source = importlib.util.spec_from_file_location("gallery", ROOT / "docs" / "gallery.py")
    gallery = importlib.util.module_from_spec(source)
    source.loader.exec_module(gallery)
    for effect in ehsvjax.effects.BANK:
        assert set(gallery.SIZES[gallery.title_of(effect)]) == {number.name for number in effect.parameters}
        assert effect.kind in gallery.KINDS
    assert len(gallery.SIZES) == len({gallery.title_of(effect) for effect in ehsvjax.effects.BANK})
