#!/bin/sh
# Starts the server on a free port, lets HalfCheetah run in a wind that it cannot see and that turns round, with latents and by the same
# network without them, and leaves numbers, a plot and a film of both in out/.
set -eu
episodes=${DEMO_EPISODES:-16}
python=.venv/bin/python
mkdir -p out
port=$($python -c 'import socket; s = socket.socket(); s.bind(("127.0.0.1", 0)); print(s.getsockname()[1])')
target/release/ada-server --listen "127.0.0.1:$port" >out/server.log 2>&1 &
server=$!
trap 'kill $server 2>/dev/null; wait $server 2>/dev/null || true' EXIT
tries=0
until $python -c "import urllib.request; urllib.request.urlopen('http://127.0.0.1:$port/readyz')" 2>/dev/null; do
    kill -0 $server 2>/dev/null || { echo "the server ended; its log:" >&2; cat out/server.log >&2; exit 1; }
    tries=$((tries + 1))
    [ $tries -lt 100 ] || { echo "the server is not ready; see out/server.log" >&2; exit 1; }
    sleep 0.1
done
echo "server ready on 127.0.0.1:$port, log in out/server.log"
.venv/bin/ada-rollout --env cheetah-gale-s --model cheetah-gale-s --beside cheetah-gale-s-without-latents --url "grpc://127.0.0.1:$port" \
    --episodes "$episodes" --seed 1000 --json out/demo.json --plot out/demo.png --film out/demo.gif
