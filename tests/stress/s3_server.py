"""An S3 server on this machine, moto's, that is slow and fails when told to.

`python -m tests.stress.s3_server` prints its port and serves until its input ends. Each request waits for
the latency first. A failing one is answered with 503 or 500, loses its connection, or ends in the middle
of its body; which ones fail is drawn from their number, so that a run can be repeated.
"""

from __future__ import annotations

import json
import os
import random
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

CONTROL = "/-control-"
ACCOUNT = {"AWS_ACCESS_KEY_ID": "test", "AWS_SECRET_ACCESS_KEY": "test", "AWS_DEFAULT_REGION": "us-east-1"}


class Server:
    """What a test knows of the server."""

    def __init__(self, port: int):
        self.url = f"http://127.0.0.1:{port}"
        self.environment = ACCOUNT | {"AWS_ENDPOINT_URL": self.url}

    def tell(self, *, latency: float = 0.0, failing: float = 0.0) -> int:
        """Seconds before each answer and the share of requests that fail, from now on. Returns how many
        requests there were since it was last told."""
        facts = json.dumps({"latency": latency, "failing": failing}).encode()
        with urllib.request.urlopen(self.url + CONTROL, facts) as answer:
            return int(answer.read())


@contextmanager
def serve() -> Iterator[Server]:
    """A server in a process of its own."""
    process = subprocess.Popen(
        [sys.executable, "-m", "tests.stress.s3_server"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        env=os.environ | ACCOUNT,
    )
    try:
        yield Server(int(process.stdout.readline()))
    finally:
        process.stdin.close()
        process.wait(30)


class _Faulty:
    """A WSGI application before another one."""

    def __init__(self, application):
        self.application = application
        self.latency = self.failing = 0.0
        self.count, self.lock = 0, threading.Lock()

    def __call__(self, environ: Mapping, start_response):
        if environ["PATH_INFO"] == CONTROL:
            return self._control(environ, start_response)
        with self.lock:
            self.count += 1
            number = self.count
        time.sleep(self.latency)
        rng = random.Random(number)
        if rng.random() >= self.failing:
            return self.application(environ, start_response)
        kind = rng.randrange(4)
        if kind < 2:
            start_response(("503 Slow Down", "500 Internal Server Error")[kind], [("Content-Length", "0")])
            return [b""]
        body = b"".join(self.application(environ, start_response)) if kind == 3 else b""
        return self._cut_off(environ["werkzeug.socket"], body[: len(body) // 2])

    def _control(self, environ: Mapping, start_response):
        facts = json.loads(environ["wsgi.input"].read(int(environ["CONTENT_LENGTH"])))
        self.latency, self.failing = facts["latency"], facts["failing"]
        answer, self.count = str(self.count).encode(), 0
        start_response("200 OK", [("Content-Length", str(len(answer)))])
        return [answer]

    def _cut_off(self, socket, body: bytes):
        if body:
            yield body
        socket.close()
        raise ConnectionAbortedError("on purpose")


def main() -> None:
    from moto.server import DomainDispatcherApplication, create_backend_app
    from werkzeug.serving import WSGIRequestHandler, make_server

    class Handler(WSGIRequestHandler):
        protocol_version = "HTTP/1.1"  # connections stay open, as S3's do

        def log_request(self, *_) -> None:
            pass

    application = _Faulty(DomainDispatcherApplication(create_backend_app))
    server = make_server("127.0.0.1", 0, application, threaded=True, request_handler=Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    print(server.server_port, flush=True)
    sys.stdin.read()
    os._exit(0)


if __name__ == "__main__":
    main()
