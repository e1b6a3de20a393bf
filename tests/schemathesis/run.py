#!/usr/bin/env python3
"""Tries every endpoint of a running binary with schemathesis, against the description that the binary itself gives.

    pip install schemathesis requests
    cargo build && tests/schemathesis/run.py target/debug/cairn

Starts the service on a directory of its own with a project, scans, a decision, a webhook and uploads, then lets schemathesis send requests with
made-up ids and with real ones, and requests that follow links. Fails on a 5xx, a status, header, media type or body that the
description does not have, and on fewer than 5,000 requests.
"""

import base64
import json
import pathlib
import random
import subprocess
import sys
import tempfile

import requests

HERE = pathlib.Path(__file__).resolve().parent
CHECKS = ("not_a_server_error,status_code_conformance,content_type_conformance,response_headers_conformance,"
          "response_schema_conformance")
LEAST = 5000


def scan(seed: int) -> bytes:
    """A corner of a room as text, seen from a place that depends on the seed."""
    rnd = random.Random(seed)
    span = lambda a, b: rnd.uniform(a, b) - 0.1 * seed
    rows = [(span(-2, 2), span(-2, 2), -1.3) for _ in range(2500)]
    rows += [(2 - 0.1 * seed, span(-2, 2), rnd.uniform(-1.3, 1)) for _ in range(2500)]
    rows += [(span(-2, 2), 2 - 0.1 * seed, rnd.uniform(-1.3, 1)) for _ in range(2500)]
    return "\n".join("%.3f %.3f %.3f" % row for row in rows).encode()


def furnish(api: str) -> dict[str, str]:
    """Makes one of everything; returns real values of parameters."""
    project = requests.post(f"{api}/v1/projects", json={"name": "Town hall", "resolution": 0.1}).json()["id"]
    own = f"{api}/v1/projects/{project}"
    answers = [requests.post(f"{own}/scans?name={i}.xyz", data=scan(i)).json() for i in range(3)]
    for answer in answers:
        requests.get(f"{api}/v1/jobs/{answer['job']['id']}?wait=60")
    ids = [answer["scan"]["id"] for answer in answers]
    decision = requests.post(f"{own}/decisions", json={"verdict": "forbid", "scan_a": ids[0], "scan_b": ids[1]})
    hook = requests.post(f"{own}/webhooks", json={"url": "https://hooks.example.com/cairn"})
    encode = lambda text: base64.b64encode(text.encode()).decode()
    announced = requests.post(f"{api}/v1/uploads", headers={
        "tus-resumable": "1.0.0", "upload-length": "100000",
        "upload-metadata": f"project {encode(project)},name {encode('a.xyz')}"})
    return {
        "project": project, "scan": ids[2], "job": answers[0]["job"]["id"],
        "decision": decision.json()["decision"]["id"], "webhook": hook.json()["id"],
        "upload": announced.headers["location"].rsplit("/", 1)[1], "tus-resumable": "1.0.0",
    }


def run(api: str, work: pathlib.Path, name: str, values: dict[str, str], more: list[str]) -> int:
    """One run of schemathesis; returns how many requests it sent, or ends the program."""
    lines = [f"{json.dumps(key)} = {json.dumps(value)}" for key, value in values.items()]
    (work / "schemathesis.toml").write_text('hooks = "hooks"\n[parameters]\n' + "\n".join(lines) + "\n")
    (work / "hooks.py").write_text((HERE / "hooks.py").read_text())
    report = work / f"{name}.ndjson"
    command = [sys.executable, "-m", "schemathesis.cli", "run", f"{api}/openapi.yaml", "-c", CHECKS, "--continue-on-failure",
               "--request-timeout", "100", "--no-color", "--warnings", "off", "--report-ndjson-path", str(report), *more]
    result = subprocess.run(command, cwd=work, text=True, capture_output=True)
    if result.returncode != 0:
        print(result.stdout[-20000:], result.stderr[-2000:])
        sys.exit(f"{name}: schemathesis has found something")
    sent = next((line for line in result.stdout.splitlines() if "generated" in line), "0 generated")
    count = int("".join(filter(str.isdigit, sent.split("generated")[0])))
    print(f"{name}: {count} requests", flush=True)
    return count


def main() -> None:
    binary = pathlib.Path(sys.argv[1]).resolve()
    examples = sys.argv[2] if len(sys.argv) > 2 else "60"
    with tempfile.TemporaryDirectory() as folder:
        work = pathlib.Path(folder)
        # One client alone may ask as often as it likes here; messages may be sent to a host that does not exist.
        service = subprocess.Popen([binary, "serve", "--listen", "127.0.0.1:0", "--data", work / "data",
                                    "--requests-per-second", "0", "--webhook-hosts", "hooks.example.com"],
                                   stdout=subprocess.PIPE, stderr=open(work / "log", "w"), text=True)
        try:
            api = service.stdout.readline().strip().removeprefix("listening on ")
            keep = ["--exclude-path-regex", r"^/v1/projects/\{project\}$"]
            total = run(api, work, "made-up ids", {"tus-resumable": "1.0.0"}, ["-n", examples])
            # What ends a project, a scan, a job or an upload has its turn when everything else had.
            gentle = ["--exclude-method", "DELETE", *keep]
            total += run(api, work, "real ids", furnish(api), ["-n", examples, "--phases", "examples,coverage,fuzzing", *gentle])
            total += run(api, work, "real ids, deletions", furnish(api),
                         ["-n", "20", "--phases", "examples,coverage,fuzzing", "--include-method", "DELETE"])
        finally:
            service.terminate()
            service.wait(60)
        if total < LEAST:
            sys.exit(f"{total} requests are fewer than {LEAST}")
        print(f"{total} requests, no finding")


if __name__ == "__main__":
    main()
