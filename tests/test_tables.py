"""The measured tables of the pages are those of the kept results."""

import json

import pytest

from benchmarks.tables import PAGES, commands, result_file, rewritten


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_a_measured_table_is_its_kept_result(page):
    text = page.read_text()
    results = {command: json.loads(result_file(command).read_text()) for command in commands(text)}
    assert rewritten(text, results) == text
