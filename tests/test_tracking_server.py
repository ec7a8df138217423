"""Mirrors on a server: a small real one on loopback that answers what W&B asks, and ones that fail in every way."""

from __future__ import annotations

import gzip
import json
import os
import socket
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest
from tracking_tools import ID, RUN, spec

from acmr.config import ConfigError
from acmr.records import EpisodeRecord
from acmr.tracking import wandb_backend
from acmr.tracking.mirror import main, sync, unsent
from acmr.tracking.observer import Observer
from acmr.tracking.watchers import make_tracker

KEY = "k" * 40


class Server(ThreadingHTTPServer):
    """Keeps the rows, the files and the descriptions of the runs that it is sent."""

    daemon_threads = True

    def __init__(self, refuse: int | None = None) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.refuse = refuse
        self.rows: dict[str, dict[int, dict[str, Any]]] = defaultdict(dict)
        self.runs: dict[str, dict[str, Any]] = defaultdict(dict)
        self.files: list[str] = []
        threading.Thread(target=self.serve_forever, args=(0.02,), daemon=True).start()

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_port}"

    def history(self, run: str) -> list[dict[str, Any]]:
        """The rows of a run in their order, without what W&B adds."""
        rows = self.rows[run]
        assert sorted(rows) == list(range(len(rows)))
        return [{k: v for k, v in rows[i].items() if not k.startswith("_")} for i in range(len(rows))]

    def stop(self) -> None:
        self.shutdown()
        self.server_close()


class Handler(BaseHTTPRequestHandler):
    """Answers the operations that W&B's client needs to deliver a run."""

    server: Server
    protocol_version = "HTTP/1.1"

    def do_GET(self) -> None:
        self._send({})

    def do_PUT(self) -> None:
        self._body()
        self.server.files.append(self.path)
        self._send({})

    def do_POST(self) -> None:
        content = json.loads(self._body())
        if self.server.refuse is not None:
            self._send({"errors": [{"message": "refused"}]}, self.server.refuse)
        elif self.path == "/graphql":
            self._send({"data": self._answer(content["operationName"], content["variables"])})
        elif self.path.endswith("/file_stream"):
            run = self.path.split("/")[-2]
            part = (content.get("files") or {}).get("wandb-history.jsonl", {"offset": 0, "content": []})
            for index, line in enumerate(part["content"]):
                self.server.rows[run][part["offset"] + index] = json.loads(line)
            self._send({"exitcode": None, "limits": {}})
        else:
            self._send({})

    def _answer(self, operation: str, given: dict[str, Any]) -> dict[str, Any]:
        if operation == "UpsertBucket":
            self.server.runs[given["name"]] |= {key: value for key, value in given.items() if value is not None}
            project = {"id": "p", "name": given["project"], "entity": {"id": "e", "name": "me"}}
            bucket = {"id": "b", "name": given["name"], "displayName": given["name"], "config": "{}"}
            return {"upsertBucket": {"bucket": bucket | {"project": project}, "inserted": True}}
        if operation == "CreateRunFiles":
            files = [{"name": name, "uploadUrl": f"{self.server.url}/{name}"} for name in given["files"]]
            return {"createRunFiles": {"runID": "b", "uploadHeaders": [], "files": files}}
        return {"model": None, "serverInfo": {"features": []}}

    def _body(self) -> bytes:
        body = self.rfile.read(int(self.headers.get("Content-Length") or 0))
        return gzip.decompress(body) if self.headers.get("Content-Encoding") == "gzip" else body

    def _send(self, content: dict[str, Any], status: int = 200) -> None:
        body = json.dumps(content).encode()
        self.send_response(status)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def server() -> Iterator[Server]:
    running = Server()
    yield running
    running.stop()


@pytest.fixture(autouse=True)
def _key(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WANDB_API_KEY", KEY)


def start(output_dir: Path, warnings: list[str], url: str | None = None, name: str = RUN) -> Observer:
    return make_tracker(spec(output_dir, name, base_url=url), warnings.append)


def log(tracker: Observer, rows: int) -> list[dict[str, Any]]:
    for step in range(1, rows + 1):
        tracker.on_episode(EpisodeRecord(step * 10, step / 7, 10))
    return [
        {"global_step": step * 10, "episodic_return": step / 7, "episode_length": 10} for step in range(1, rows + 1)
    ]


def closed_port() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"http://127.0.0.1:{probe.getsockname()[1]}"


@pytest.mark.slow
def test_sync_sends_every_row_once(
    tmp_path: Path, server: Server, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    folder, warnings = tmp_path / "wandb", list[str]()
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    expected = {}
    for name, rows in ((RUN, 300), ("ant-hidden", 5)):
        tracker = start(tmp_path, warnings, name=name)
        expected[f"quick-{name}-s3"] = log(tracker, rows)
        tracker.close({"status": "complete"})
    command = ["sync", "--base-url", server.url, str(folder)]
    assert main(command) == 0
    assert capfd.readouterr().out.endswith(f"2 runs sent to {server.url}\n")
    assert {run: server.history(run) for run in expected} == expected
    about = server.runs[ID]
    assert (about["groupName"], about["jobType"]) == ("quick/A2", "student")
    assert set(about["tags"]) >= {"A2", "ant_three_legs"}
    assert json.loads(about["config"])["agent"]["value"]["q_lr"] == 0.001
    # Sent is sent; a run that was repeated since is not.
    server.rows.clear()
    assert main(command) == 0
    assert not server.rows
    repeated = start(tmp_path, warnings)
    expected_again = log(repeated, 3)
    repeated.close(None)
    assert main(command) == 0
    assert {run: server.history(run) for run in server.rows} == {ID: expected_again}
    assert warnings == []
    assert list(elsewhere.iterdir()) == []


@pytest.mark.slow
def test_a_server_is_mirrored_to_at_once(tmp_path: Path, server: Server) -> None:
    warnings: list[str] = []
    tracker = start(tmp_path, warnings, server.url)
    expected = log(tracker, 20)
    until = time.monotonic() + 20
    while len(server.rows[ID]) < 20 and time.monotonic() < until:
        time.sleep(0.1)
    before_the_end = server.history(ID)
    tracker.close({"status": "complete"})
    assert before_the_end == server.history(ID) == expected
    assert server.runs[ID]["groupName"] == "quick/A2"
    assert unsent(tmp_path / "wandb") == []
    assert warnings == []


@pytest.mark.parametrize("failure", ["no server", "no answer", "no address", "no key", "key refused", "server broken"])
@pytest.mark.first_is_fast
def test_no_server_means_offline_with_one_warning(
    tmp_path: Path, failure: str, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(wandb_backend, "SERVER_WAIT", 2.0)
    stops = []
    url = closed_port()
    if failure == "no answer":
        silent = socket.create_server(("127.0.0.1", 0))
        url = f"http://127.0.0.1:{silent.getsockname()[1]}"
        stops.append(silent.close)
    elif failure == "no address":
        url = "somewhere"
    elif failure == "no key":
        monkeypatch.delenv("WANDB_API_KEY")
    elif failure != "no server":
        refusing = Server(refuse=401 if failure == "key refused" else 500)
        url = refusing.url
        stops.append(refusing.stop)
    warnings: list[str] = []
    began = time.monotonic()
    tracker = start(tmp_path, warnings, url)
    assert time.monotonic() - began < 6
    log(tracker, 5)
    tracker.close(None)
    for stop in stops:
        stop()
    (warning,) = warnings
    assert "offline" in warning
    assert "make sync" in warning
    assert "\n" not in warning
    assert capfd.readouterr() == ("", "")
    # One mirror, offline, waiting to be sent.
    assert [file.parent.name[:12] for file in unsent(tmp_path / "wandb")] == ["offline-run-"]
    late = Server()
    monkeypatch.setenv("WANDB_API_KEY", KEY)
    assert main(["sync", "--base-url", late.url, str(tmp_path / "wandb")]) == 0
    assert len(late.history(ID)) == 5
    late.stop()


@pytest.mark.slow
def test_a_server_that_goes_away_delays_nothing_and_loses_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(wandb_backend, "SERVER_WAIT", 2.0)
    first, warnings = Server(), list[str]()
    tracker = start(tmp_path, warnings, first.url)
    tracker.on_metrics(1, {"alpha": 0.5})
    first.stop()
    began = time.monotonic()
    expected = [{"global_step": 1, "alpha": 0.5}, *log(tracker, 200)]
    assert time.monotonic() - began < 2
    tracker.close({"status": "complete"})
    assert time.monotonic() - began < 8
    (warning,) = warnings
    assert "did not take everything within 2 s; `make sync` sends the rest" in warning
    second = Server()
    assert main(["sync", "--base-url", second.url, str(tmp_path / "wandb")]) == 0
    assert second.history(ID) == expected
    second.stop()


def test_sync_that_cannot_be_done_says_why_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = str(tmp_path / "wandb")
    assert main(["sync", "--base-url", "http://127.0.0.1:9", folder]) == 2
    start(tmp_path, []).close(None)
    assert main(["sync", "--base-url", "", folder]) == 2
    assert main(["sync", "--base-url", closed_port(), folder]) == 2
    monkeypatch.delenv("WANDB_API_KEY")
    assert main(["sync", "--base-url", "http://127.0.0.1:9", folder]) == 2
    lines = capsys.readouterr().err.splitlines()
    said = ["no such folder", "add --base-url", "cannot be reached", "WANDB_API_KEY is not set"]
    assert len(lines) == len(said)
    for line, words in zip(lines, said, strict=True):
        assert line.startswith("error: ")
        assert words in line


@pytest.mark.parametrize("place", ["config/settings", "wandb/settings"])
def test_settings_in_a_folder_of_mirrors_do_not_steer_wandb(place: str, tmp_path: Path, server: Server) -> None:
    file = tmp_path / "wandb" / ".home" / place
    file.parent.mkdir(parents=True)
    nowhere = closed_port()
    file.write_text(f"[default]\nproject = theirs\nhttp_proxy = {nowhere}\nhttps_proxy = {nowhere}\n")
    warnings: list[str] = []
    tracker = start(tmp_path, warnings)
    expected = log(tracker, 3)
    tracker.close(None)
    assert sync(tmp_path / "wandb", server.url) == 1
    assert server.history(ID) == expected
    assert warnings == []


@pytest.mark.parametrize("make", [os.mkfifo, lambda path: path.symlink_to("/etc/hostname")], ids=["pipe", "link"])
def test_sync_sends_nothing_that_lies_elsewhere(make: Callable[[Path], None], tmp_path: Path, server: Server) -> None:
    mirror = tmp_path / "wandb" / "offline-run-20261126_113255-sent"
    (mirror / "files").mkdir(parents=True)
    (mirror / "run-sent.wandb").write_bytes(b":W&B")
    make(mirror / "files" / "notes.txt")
    with pytest.raises(ConfigError, match=r"files/notes\.txt: no regular file; W&B would send what it leads to"):
        sync(tmp_path / "wandb", server.url)
