"""How cost grows: server-side and client-side times over the number of sessions, and denoiser times over its sizes. Markdown tables.

    cargo build --release --bins --examples && python3 benches/growth.py

Starts a server of its own with random weights of HalfCheetah's sizes; needs nothing but the two programs and Python.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import tempfile
import time
import urllib.request
from pathlib import Path
from typing import Any

RELEASE = Path(__file__).resolve().parent.parent / "target/release"
PORT = 7798


def output(program: str, *arguments: str) -> str:
    run = subprocess.run([RELEASE / program, *arguments], check=True, capture_output=True, text=True)
    return run.stdout


def row(*cells: object) -> None:
    print("| " + " | ".join(f"{cell:.3g}" if isinstance(cell, float) else str(cell) for cell in cells) + " |", flush=True)


def header(*names: str) -> None:
    row(*names)
    row(*("---" for _ in names))


def load(*arguments: str) -> dict[str, Any]:
    text = output("examples/load", "--url", f"http://127.0.0.1:{PORT}", "--model", "random", "--json", *arguments)
    return json.loads(text)


def sessions(counts: list[int], seconds: float) -> None:
    """Where the time of an act goes, for many sessions that act at the same time (closed loop, one stream a connection)."""
    with tempfile.TemporaryDirectory() as models:
        output("examples/make_random", "--out", f"{models}/random")
        settings = ["sessions.len_max=20000", "engine.queue_len_max=20000", "telemetry.log=warn"]
        flags = [flag for setting in settings for flag in ("--set", setting)]
        address = ["--listen", f"127.0.0.1:{PORT}", "--models", models, "--default-model", "random"]
        server = subprocess.Popen([RELEASE / "ada-server", *address, *flags])
        try:
            wait_until_ready()
            for streaming in ("true", "false"):
                print(f"\nstreaming={streaming}\n")
                header("sessions", "acts/s", "p50 ms", "p99 ms", "p99.9 ms", "queue ms", "compute ms", "commit ms", "the rest ms")
                for count in counts:
                    options = ["--clients", str(count), "--seconds", str(seconds), "--face", "stream"]
                    report = load(*options, "--set", f"streaming={streaming}", "--set", "temperature=0")
                    latency, parts = report["latency_ms"], report["server_ms"]
                    rest = latency["mean"] - parts["queue"] - parts["compute"] - parts["commit"]
                    shown = [float(parts[part]) for part in ("queue", "compute", "commit")]
                    tails = [float(latency[name]) for name in ("p50", "p99", "p999")]
                    row(count, round(report["acts_per_s"]), *tails, *shown, float(rest))
        finally:
            server.terminate()
            server.wait()


def wait_until_ready() -> None:
    for _ in range(200):
        try:
            urllib.request.urlopen(f"http://127.0.0.1:{PORT}/readyz").close()
            return
        except OSError:
            time.sleep(0.1)
    raise SystemExit("the server did not get ready")


def denoiser(seconds: float) -> None:
    """One evaluation on one core over the sizes of the network, for 1 and 32 windows."""
    unet = [["--net", "unet", "--widths", widths] for widths in ("16,32,32,32", "32,64,64,64", "32,64,128,256")]
    long = [["--net", "unet", "--len", str(length)] for length in (32, 64)]
    dit = [["--net", "dit", "--width", str(width), "--len", str(length)] for width, length in ((64, 16), (256, 16), (256, 42))]
    half = [["--net", "unet", "--weights", "bf16"], ["--net", "unet", "--widths", "32,64,128,256", "--weights", "bf16"]]
    print()
    header("network", "1 window, ms", "32 windows, ms")
    for sizes in [*unet, *long, *dit, *half]:
        times = [
            float(json.loads(output("examples/time_denoisers", *sizes, "--batch", str(batch), "--seconds", str(seconds)))["ms"])
            for batch in (1, 32)
        ]
        row(" ".join(sizes).replace("--", ""), *times)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sessions", default="1,4,16,64,256,1024,4096", help="numbers of sessions")
    parser.add_argument("--seconds", type=float, default=3.0, help="for each row")
    flags = parser.parse_args()
    denoiser(min(flags.seconds, 1.0))
    sessions([int(count) for count in flags.sessions.split(",")], flags.seconds)
