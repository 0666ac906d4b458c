"""The certificates of a drive and its client, made as the error message of a missing one says."""

from __future__ import annotations

import re
import shutil
import subprocess

import pytest
from drives import running

from endopilot.errors import InputError
from endopilot.robot.drive import tls_context


@pytest.fixture(scope="session")
def make_certificates():
    """Return a function that makes a folder with the keys and certificates of both sides."""
    if shutil.which("openssl") is None:
        pytest.skip("openssl is not installed")

    def make(folder):
        with pytest.raises(InputError, match="no such file") as caught:
            tls_context(folder, of_drive=True)
        recipe = (
            re.search("`(.*)`", str(caught.value)).group(1).replace("rsa:3072", "ec -pkeyopt ec_paramgen_curve:P-256")
        )  # faster
        subprocess.run(recipe, shell=True, check=True, capture_output=True)
        return folder

    return make


@pytest.fixture(scope="session")
def certificates(make_certificates, tmp_path_factory):
    """Return a folder with the keys and certificates of a drive and its client."""
    return make_certificates(tmp_path_factory.mktemp("certificates of a drive") / "keys")


@pytest.fixture(scope="module")
def drive(certificates):
    """Start a drive, and return its process and the port."""
    with running(certificates) as started:
        yield started
