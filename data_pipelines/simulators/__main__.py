"""A worker process of the simulator suite; see `worker`."""

from __future__ import annotations

import os
import sys

from data_pipelines.simulators.worker import Job, run_job

if __name__ == "__main__":
    run_job(Job.from_json(sys.argv[1]))
    # Exits without the destructors of drivers, some of which abort under EGL: everything is written by now.
    sys.stdout.flush()
    os._exit(0)
