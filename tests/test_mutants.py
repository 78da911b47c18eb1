"""The faults of mutants.yaml can still be planted: `nox -s mutants` checks that tests catch them."""

import re

import pytest
from mutants import REPOSITORY, load

FAULTS = load()


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: f"{fault.file}: {fault.fault}")
def test_a_fault_occurs_once_and_its_tests_exist(fault):
    assert (REPOSITORY / fault.file).read_text(encoding="utf-8").count(fault.text) == 1
    assert fault.becomes != fault.text
    assert fault.tests
    for test in fault.tests:
        path, _, name = test.partition("[")[0].partition("::")
        assert (REPOSITORY / path).exists(), test
        assert not name or re.search(rf"^def {name}\(", (REPOSITORY / path).read_text(encoding="utf-8"), re.M), test


def test_faults_are_in_most_packages():
    packages = {fault.file.split("/")[1] for fault in FAULTS}
    assert len(FAULTS) >= 60
    assert len(packages) >= 14, packages
