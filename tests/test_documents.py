"""What is written for those who join: its code runs, its links lead somewhere, its versions are the package's."""

import importlib.metadata
import re
from pathlib import Path

import pytest

import ehsvjax
from ehsvjax import effects
from ehsvjax.effects.internal import contexts_of

ROOT = Path(__file__).parents[1]
DOCUMENTS = ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")


def blocks_of(document):
    return re.findall(r"```python\n(.*?)```", (ROOT / document).read_text(), re.DOTALL)


def test_the_first_effect_and_the_first_model_run():
    first_effect, first_model = blocks_of("CONTRIBUTING.md")
    found: dict = {}
    exec(first_effect, found)
    model = ehsvjax.van_der_pol()
    tried = effects.candidates(model, found["diagnosis_bank"], contexts_of(model), model.outputs)
    assert "magnet" in [candidate.name for candidate in tried]
    exec(first_model, found)
    fit = found["fit"]
    assert fit.parameters["gain"] == pytest.approx(0.6 / 15.0, rel=0.02)
    assert fit.parameters["time_constant"] == pytest.approx(15.0, rel=0.02)


@pytest.mark.parametrize("document", DOCUMENTS)
def test_links_lead_somewhere(document):
    for link in re.findall(r"\]\(([^)\s]+)\)", (ROOT / document).read_text()):
        assert link.startswith("https://") or (ROOT / link).exists(), link


@pytest.mark.parametrize("document", DOCUMENTS)
def test_code_in_documents_can_be_read(document):
    for block in blocks_of(document):
        compile(block, document, "exec")


def test_versions_agree():
    version = ehsvjax.__version__
    assert importlib.metadata.version("ehsvjax") == version
    assert re.search(r"^version: (.+)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)[1] == version
    assert f"## {version}" in (ROOT / "CHANGELOG.md").read_text()
