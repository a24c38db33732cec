"""Where a campaign's workers come from: batch jobs as the file asks for them, schedulers that are there or not."""

from __future__ import annotations

import contextlib
import signal
import socket
import ssl
import sys
import urllib.error
import urllib.request
import warnings
from pathlib import Path

import pytest

from md_reference.campaign import cluster
from md_reference.campaign.campaign_file import ClusterSpec, read_campaign
from md_reference.campaign.cluster import job_cluster, open_client
from md_reference.campaign.manifest import COMPLETE
from md_reference.campaign.scheduler import run_campaign
from systems.errors import InputError

pytest.importorskip("dask_jobqueue")


def test_a_slurm_job_asks_for_what_the_file_says(tmp_path: Path) -> None:
    spec = ClusterSpec(
        kind="slurm",
        jobs=20,
        cores=8,
        memory="16GB",
        walltime="12:00:00",
        queue="cpu",
        account="chem",
        directives=("--exclude=node7",),
        prologue=("module load python/3.12",),
    )
    with job_cluster(spec, tmp_path) as cluster:
        lines = cluster.job_script().splitlines()
        assert not cluster.workers, "no job before there is work"
    assert {"#SBATCH -p cpu", "#SBATCH -A chem", "#SBATCH -t 12:00:00", "#SBATCH --exclude=node7"} <= set(lines)
    assert "#SBATCH --cpus-per-task=8" in lines
    worker = next(line for line in lines if "--preload md_reference.campaign.cluster" in line)
    assert "--nworkers 8" in worker
    assert "--nthreads 1" in worker
    before = lines[: lines.index(worker)]
    assert "export OPENMM_CPU_THREADS=1" in before
    assert "module load python/3.12" in before


def test_one_worker_in_a_job_without_a_queue(tmp_path: Path) -> None:
    with job_cluster(ClusterSpec(kind="pbs", walltime="01:00:00"), tmp_path) as cluster:
        script = cluster.job_script()
    assert "#PBS -l walltime=01:00:00" in script
    assert "#PBS -q" not in script
    assert "--nthreads 1" in script


def test_ctrl_c_stays_what_it_was(tmp_path: Path) -> None:
    for name in [name for name in sys.modules if name.startswith("dask_jobqueue")]:
        del sys.modules[name]
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with job_cluster(ClusterSpec(kind="slurm"), tmp_path):
            assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)


def test_local_jobs_start_without_a_shell(tmp_path: Path) -> None:
    with job_cluster(ClusterSpec(kind="local"), tmp_path) as cluster:
        words = cluster.job_script().split()
    assert words[:2] == ["env", "OMP_NUM_THREADS=1"] and "export" not in words
    with pytest.raises(InputError, match="local takes no prologue"):
        job_cluster(ClusterSpec(kind="local", prologue=("module load x",)), tmp_path)


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


def test_a_busy_port_of_dask_s_pages_is_no_matter(tmp_path: Path) -> None:
    with socket.socket() as busy, warnings.catch_warnings():
        warnings.simplefilter("error")
        with contextlib.suppress(OSError):  # another's, just as well
            busy.bind(("127.0.0.1", 8787))
            busy.listen()
        with open_client(workers=1) as client:
            assert client.submit(lambda: 6 * 7).result(timeout=60) == 42
        with job_cluster(ClusterSpec(kind="local"), tmp_path) as cluster:
            assert cluster.scheduler_address.startswith("tls://127.0.0.1:")


def test_jobs_talk_by_tls_and_show_nothing(tmp_path: Path) -> None:
    with job_cluster(ClusterSpec(kind="local"), tmp_path) as cluster:
        words = cluster.job_script().split()
        assert cluster.scheduler_address.startswith("tls://127.0.0.1:")
        for option in ("--tls-key", "--tls-cert", "--tls-ca-file"):
            assert Path(words[words.index(option) + 1]).stat().st_mode & 0o077 == 0
        assert {"--no-dashboard", "DASK_DISTRIBUTED__WORKER__HTTP__ROUTES=[]"} <= set(words)


@pytest.mark.slow
def test_a_campaign_through_dask_jobqueue(tmp_path: Path) -> None:
    file = tmp_path / "c.toml"
    file.write_text(
        'scenes = ["alanine-dipeptide"]\nreplicas = 2\ntime = "2ps"\nsave_every = "100fs"\nequilibrate = "1ps"\n'
        'platform = "Reference"\n[cluster]\nkind = "local"\njobs = 1\nmemory = "1GB"\n'
    )
    campaign = read_campaign(file)
    with open_client(cluster=campaign.cluster, folder=campaign.folder) as client:
        manifest = run_campaign(campaign, client)
    assert manifest.counts() == {COMPLETE: 2}


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
