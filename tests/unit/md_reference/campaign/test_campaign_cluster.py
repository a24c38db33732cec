"""Where a campaign's workers come from: processes of this machine, and schedulers that are there or not."""

from __future__ import annotations

import contextlib
import socket
import ssl
import urllib.error
import urllib.request
import warnings
from pathlib import Path

import pytest

from md_reference.campaign import cluster
from md_reference.campaign.campaign_file import read_campaign
from md_reference.campaign.cluster import open_client
from md_reference.campaign.manifest import COMPLETE
from md_reference.campaign.scheduler import run_campaign
from systems.errors import InputError


def test_no_scheduler_is_said_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "_ANSWER_S", 0.5)
    with (
        pytest.raises(InputError, match=r"no Dask scheduler answers at tcp://127\.0\.0\.1:9") as caught,
        open_client(scheduler="tcp://127.0.0.1:9"),
    ):
        pass
    assert "\n" not in str(caught.value)


def test_workers_here_and_a_scheduler_there_exclude_each_other() -> None:
    with pytest.raises(InputError, match="give one of them"), open_client(workers=2, scheduler="tcp://127.0.0.1:9"):
        pass


def answer_to(address: str, context: ssl.SSLContext | None) -> bytes:
    """Return the first bytes that a scheduler says to whoever connects, nothing when it hangs up."""
    host, port = address.removeprefix("tls://").split(":")
    try:
        with socket.create_connection((host, int(port)), timeout=30) as plain:
            line = plain if context is None else context.wrap_socket(plain)
            line.sendall(bytes(64))
            return line.recv(1)
    except (ssl.SSLError, ConnectionError):
        return b""


def test_a_scheduler_lets_nobody_in_who_has_not_its_certificate() -> None:
    from distributed import Security

    with open_client(workers=1) as client:
        address = client.scheduler.address
        assert address.startswith("tls://127.0.0.1:")
        assert client.submit(lambda: 6 * 7).result(timeout=60) == 42
        nobody = ssl._create_unverified_context()
        stranger = Security.temporary().get_connection_args("client")["ssl_context"]
        stranger.check_hostname, stranger.verify_mode = False, ssl.CERT_NONE
        known = client.security.get_connection_args("client")["ssl_context"]
        assert answer_to(address, known), "who has the certificate is greeted"
        assert [answer_to(address, context) for context in (None, nobody, stranger)] == [b"", b"", b""]
        port = client.scheduler_info()["services"]["dashboard"]
        for page in ("status", "info/main/workers.html", "json/counts.json"):
            with pytest.raises(urllib.error.HTTPError, match="404"):
                urllib.request.urlopen(f"http://127.0.0.1:{port}/{page}", timeout=30)


def test_a_busy_port_of_dask_s_pages_is_no_matter() -> None:
    with socket.socket() as busy, warnings.catch_warnings():
        warnings.simplefilter("error")
        with contextlib.suppress(OSError):  # another's, just as well
            busy.bind(("127.0.0.1", 8787))
            busy.listen()
        with open_client(workers=1) as client:
            assert client.submit(lambda: 6 * 7).result(timeout=60) == 42


@pytest.mark.slow
def test_a_campaign_on_a_scheduler_that_runs_already(tmp_path: Path) -> None:
    from distributed import LocalCluster

    file = tmp_path / "c.toml"
    file.write_text(
        'scenes = ["alanine-dipeptide"]\nreplicas = 2\ntime = "2ps"\nsave_every = "100fs"\nequilibrate = "1ps"\n'
        'platform = "Reference"\n'
    )
    campaign = read_campaign(file)
    with LocalCluster(n_workers=1, threads_per_worker=2, dashboard_address=None) as cluster:
        with open_client(scheduler=cluster.scheduler_address) as client:
            manifest = run_campaign(campaign, client)
        assert manifest.counts() == {COMPLETE: 2}
        assert len(cluster.workers) == 1, "workers of others are left alone"
