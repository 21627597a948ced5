"""A sweep through a real Slurm of two nodes on this machine, with everything that happens to jobs on a cluster.

    python -m tests.stress.slurm_sweep

Starts munged, slurmctld and two slurmd of its own, and stops them at the end. It must run as root, with Debian's
packages slurm-wlm and munge and the extra `slurm` installed. A job is cancelled, a job is requeued, a node is
drained and then goes down with its job, and the command itself is killed and started again. The last line says
whether the CSV has the bytes of the same sweep on one machine; exits with 1 otherwise.
"""

from __future__ import annotations

import argparse
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.stress.launched import Sweep, run_here, steps_within

CONFIGURATION = """
ClusterName=stress
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={port}
SlurmUser=root
SlurmdUser=root
AuthType=auth/munge
AuthInfo=cred_expire=5
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
ReturnToService=2
MpiDefault=none
KillWait=60
StateSaveLocation={root}/state
SlurmdSpoolDir={root}/spool-%n
SlurmctldPidFile={root}/slurmctld.pid
SlurmdPidFile={root}/slurmd-%n.pid
SlurmctldLogFile={root}/slurmctld.log
SlurmdLogFile={root}/slurmd-%n.log
NodeName=one,two NodeHostname={host} NodeAddr=127.0.0.1 Port=[{first}-{second}] CPUs=1 State=UNKNOWN
PartitionName=all Nodes=ALL Default=YES MaxTime=INFINITE State=UP
"""


def slurm(*words: str) -> str:
    return subprocess.run(words, check=True, capture_output=True, text=True, timeout=60).stdout


@contextmanager
def cluster(root: Path) -> Iterator[dict[str, str]]:
    """Two nodes of one processor each; yields the environment in which Slurm's commands find them."""
    missing = [name for name in ("munged", "slurmctld", "slurmd", "sbatch") if shutil.which(name) is None]
    if missing or os.geteuid() != 0:
        raise SystemExit(f"needs root and Debian's slurm-wlm and munge (missing: {', '.join(missing) or 'root'})")
    root.mkdir(parents=True)
    (root / "state").mkdir()
    ports = free_ports(3)
    configuration = root / "slurm.conf"
    names = {"host": socket.gethostname(), "root": root, "port": ports[0], "first": ports[1], "second": ports[1] + 1}
    configuration.write_text(CONFIGURATION.format(**names))
    os.environ["SLURM_CONF"] = str(configuration)
    started = start_munge(root)
    try:
        slurm("slurmctld")
        for node in ("one", "two"):
            slurm("slurmd", "-N", node)
        wait_until(lambda: slurm("sinfo", "--noheader", "--Node", "--format=%t").split() == ["idle", "idle"])
        yield {"SLURM_CONF": str(configuration)}
    finally:
        subprocess.run(["scancel", "--me"], check=False)
        time.sleep(2)
        for file in [*root.glob("*.pid"), *started]:
            stop_daemon(file)
        for process in ours(configuration):  # steps of a node that went down outlive it
            os.kill(process, signal.SIGKILL)


def start_munge(root: Path) -> list[Path]:
    """Starts munged unless one answers; its pid file, if it is ours to stop."""
    if subprocess.run(["munge", "-n"], capture_output=True, check=False).returncode == 0:
        return []
    run = Path("/run/munge")
    run.mkdir(exist_ok=True)
    shutil.chown(run, "munge", "munge")
    slurm("runuser", "-u", "munge", "--", "munged")
    return [run / "munged.pid"]


def stop_daemon(pid_file: Path) -> None:
    try:
        os.kill(int(pid_file.read_text()), signal.SIGTERM)
    except (OSError, ValueError):  # it has ended
        return


def ours(configuration: Path) -> list[int]:
    """What is left of this cluster: processes, but this one, that were told of its configuration."""
    told = f"SLURM_CONF={configuration}".encode()
    found = []
    for path in Path("/proc").glob("[0-9]*/environ"):
        try:
            if told in path.read_bytes().split(b"\0"):
                found.append(int(path.parent.name))
        except OSError:  # it has ended
            continue
    return [process for process in found if process != os.getpid()]


def free_ports(count: int) -> list[int]:
    """A port, and one whose successor is free as well."""
    while True:
        with socket.socket() as one, socket.socket() as two, socket.socket() as three:
            one.bind(("127.0.0.1", 0))
            two.bind(("127.0.0.1", 0))
            port = two.getsockname()[1]
            try:
                three.bind(("127.0.0.1", port + 1))
            except OSError:
                continue
            return [one.getsockname()[1], port, port + 1][:count]


def wait_until(condition, seconds: float = 120.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > deadline:
            raise SystemExit("Slurm does not come up; see the logs beside its configuration")
        time.sleep(0.5)


def node_of(job: str) -> str:
    return slurm("squeue", "--noheader", "--job", job, "--format=%N").strip()


def disturb(sweep: Sweep) -> None:
    first = sweep.wait_for("a trial to cancel", sweep.training)
    slurm("scancel", first["job"])
    second = sweep.wait_for("a trial to requeue", lambda: sweep.training([first["trial"]]))
    slurm("scontrol", "requeue", second["job"])
    sweep.wait_for_start("the one is submitted and starts again", first["trial"], 1)
    sweep.wait_for_start("the other starts again", second["trial"], 1)

    sweep.wait_for("a trial in the middle when the command is killed", sweep.training)
    starts = sweep.starts()
    sweep.process.kill()
    sweep.process.wait()
    sweep.start()

    third = sweep.wait_for("a trial whose node is drained", sweep.training)
    node = node_of(third["job"])
    slurm("scontrol", "update", f"nodename={node}", "state=drain", "reason=stress")
    time.sleep(5)
    busy = slurm("squeue", "--noheader", f"--nodelist={node}", "--states=running", "--format=%i").split()
    if busy != [third["job"]]:
        sweep.fail(f"on the drained node {node} run {busy}, not only {third['job']}")
    slurm("scontrol", "update", f"nodename={node}", "state=down", "reason=stress")
    before = starts[third["trial"]]
    sweep.wait_for_start(f"node {node} is down, its trial starts on the other", third["trial"], before)
    slurm("scontrol", "update", f"nodename={node}", "state=resume")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=60.0, help="that a trial trains on this machine")
    seconds = parser.parse_args().seconds
    with tempfile.TemporaryDirectory() as name:
        root = Path(name)
        steps = steps_within(seconds, root)
        csv = run_here(root, steps)
        more = ("--launcher", "slurm", "--launcher-set", "cpus=1", "--launcher-set", "minutes=120")
        with cluster(root / "slurm") as environment, Sweep(root, steps, more, environment) as sweep:
            print("the same through Slurm ...", flush=True)
            disturb(sweep)
            return 0 if sweep.finish(csv) else 1


if __name__ == "__main__":
    sys.exit(main())
