"""An S3 server that holds a folder: `serve_s3.py FOLDER SECONDS LOG`.

Prints its address when all of it is there, answers every GET so many seconds late, writes a line of JSON for each
request, and ends with its input. Runs in an environment of its own (tests/owners.py).

A key that is called `wrong` is refused. A file LOG.faults plants more, anew for each request: `deny METHOD` and
`cut METHOD` refuse, or break off, what changes or reads an object. LOG.all has the method and path of every request.
"""

import json
import logging
import sys
import threading
import time
from pathlib import Path

import boto3
from moto.server import DomainDispatcherApplication, create_backend_app
from werkzeug.serving import make_server

folder, late_s, log = Path(sys.argv[1]), float(sys.argv[2]), Path(sys.argv[3])
answer = DomainDispatcherApplication(create_backend_app)
logging.getLogger("werkzeug").setLevel(logging.ERROR)


def refused(method, start, code):
    start("403 Forbidden", [("Content-Type", "application/xml")])
    return [] if method == "HEAD" else [f"<Error><Code>{code}</Code><Message>no</Message></Error>".encode()]


def told(environ, start):
    method = environ["REQUEST_METHOD"]
    with log.with_suffix(".all").open("a") as file:
        file.write(f"{method} {environ['PATH_INFO']}\n")
    faults = log.with_suffix(".faults")
    planted = faults.read_text() if faults.exists() else ""
    if "Credential=wrong/" in environ.get("HTTP_AUTHORIZATION", ""):
        return refused(method, start, "InvalidAccessKeyId")
    if planted == f"deny {method}":
        return refused(method, start, "AccessDenied")
    if planted == f"cut {method}":
        environ["werkzeug.socket"].shutdown(2)
        return refused(method, start, "Cut")
    if method == "GET":
        with log.open("a") as file:
            file.write(json.dumps([environ["PATH_INFO"], environ.get("HTTP_RANGE")]) + "\n")
        time.sleep(late_s)
    return answer(environ, start)


server = make_server("127.0.0.1", 0, told, threaded=True)
threading.Thread(target=server.serve_forever, daemon=True).start()
address = f"http://127.0.0.1:{server.server_port}"
client = boto3.client("s3", endpoint_url=address)
client.create_bucket(Bucket="flights")
for path in folder.rglob("*"):
    if path.is_file():
        client.upload_file(str(path), "flights", f"town/{path.relative_to(folder).as_posix()}")
print(address, flush=True)
sys.stdin.read()
