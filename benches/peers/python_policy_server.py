"""What a user would write today: a Python policy server (WebSocket and msgpack, the shape of openpi's) around a PyTorch denoiser, with a
closed-loop load generator, so that our figure can be held against it in the same run (compare.py does).

    python python_policy_server.py serve --port 8765 --evaluations 16      # network evaluations per act (16 = cold plan, 1 = streaming)
    python python_policy_server.py load  --port 8765 --clients 8 --seconds 5

`load` prints one JSON line: acts per second, p50 and p99 in milliseconds. Every client waits for its answer before it asks again.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import time

import msgpack
import numpy as np
import websockets


def pack(array: np.ndarray) -> dict[bytes, object]:
    """An array as openpi's clients send it."""
    return {b"__ndarray__": True, b"data": array.tobytes(), b"dtype": array.dtype.str, b"shape": list(array.shape)}


async def serve(a: argparse.Namespace) -> None:
    """Answers until it is ended; the network is warm before it listens."""
    import torch
    from torch_denoisers import TemporalUNet

    torch.set_num_threads(a.threads)
    net = TemporalUNet(59, 23, [int(width) for width in a.widths.split(",")]).eval()
    levels = torch.full((1, 16), 75)
    fast = torch.jit.optimize_for_inference(torch.jit.freeze(torch.jit.trace(net, (torch.randn(1, 16, 59), levels))))
    with torch.inference_mode():
        for _ in range(50):
            fast(torch.randn(1, 16, 59), levels)

    async def handler(ws: websockets.ServerConnection) -> None:
        await ws.send(msgpack.packb({}))
        async for message in ws:
            state = np.frombuffer(msgpack.unpackb(message, raw=False, strict_map_key=False)["state"][b"data"], np.float32)
            with torch.inference_mode():
                window = torch.randn(1, 16, 59)
                window[0, 0, :17] = torch.from_numpy(state.copy())
                for _ in range(a.evaluations):
                    window[..., :23] = 0.9 * window[..., :23] + 0.1 * fast(window, levels)
            await ws.send(msgpack.packb({"actions": pack(window[0, :, 17:23].numpy().copy())}))

    async with websockets.serve(handler, "127.0.0.1", a.port, compression=None, max_size=None):
        await asyncio.Future()


async def load(a: argparse.Namespace) -> None:
    """Latencies are those of acts asked for after the warm-up; the rate is that of the answers in the measured time."""
    state = pack(np.zeros(17, np.float32))
    times: list[float] = []
    answers = 0

    async def client(begin: float, stop: float) -> None:
        nonlocal answers
        async with websockets.connect(f"ws://127.0.0.1:{a.port}", compression=None, max_size=None) as ws:
            await ws.recv()
            while (start := time.perf_counter()) < stop:
                await ws.send(msgpack.packb({"state": state}))
                await ws.recv()
                end = time.perf_counter()
                answers += begin <= end < stop
                if start >= begin:
                    times.append(end - start)

    begin = time.perf_counter() + a.warm_up
    await asyncio.gather(*(client(begin, begin + a.seconds) for _ in range(a.clients)))
    ms = np.array(times) * 1e3
    quantiles = {name: round(float(np.quantile(ms, share)), 3) for name, share in (("p50_ms", 0.5), ("p99_ms", 0.99))}
    print(json.dumps({"clients": a.clients, "acts_per_s": round(answers / a.seconds, 1), **quantiles}))


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["serve", "load"])
    parser.add_argument("--port", type=int, default=8765)
    parser.add_argument("--evaluations", type=int, default=16)
    parser.add_argument("--widths", default="32,64,64,64")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--clients", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--warm-up", type=float, default=1.0, help="seconds before, whose acts do not count (default 1)")
    a = parser.parse_args()
    asyncio.run(serve(a) if a.what == "serve" else load(a))


if __name__ == "__main__":
    main()
