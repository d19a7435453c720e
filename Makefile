# `make demo` and `make test` are all a newcomer needs; the rest is what they are made of.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
CARGO_FLAGS := --release --locked
MODEL ?= cheetah-wind-s
RECIPE ?= models/$(MODEL)/recipe.toml
ENV ?= cheetah-wind-s
EPISODES ?= 300
DEMO_EPISODES ?= 16

.PHONY: help demo serve collect train test test-rust test-python lint load reliability bench docs proto-python tools clean

help: ## This list.
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## /  make \1\t/' | expand -t 24

tools: ## Checks that the tools are there, and says how to install what is missing.
	@deploy/check-tools.sh $(PYTHON)

demo: build venv ## Builds, serves the shipped models and lets HalfCheetah run in a wind it cannot see, with latents and without.
	@DEMO_EPISODES=$(DEMO_EPISODES) deploy/demo.sh

serve: build ## Serves models/ on loopback.
	target/release/ada-server

collect: venv ## Records rollouts: make collect ENV=point-wind-s EPISODES=400
	$(BIN)/ada-collect --env $(ENV) --episodes $(EPISODES) --out data/$(ENV).h5

train: build ## Trains a recipe: make train RECIPE=models/point-wind-s/recipe.toml
	target/release/ada-trainer run $(RECIPE)

test: test-rust test-python ## Every check there is.

test-rust: tools
	cargo test $(CARGO_FLAGS)

test-python: test-binaries venv
	$(BIN)/python -m pytest -q --durations=20 tests/python

lint: venv ## Formatting, clippy, docs and ruff, all with warnings as errors.
	cargo fmt --check
	cargo clippy $(CARGO_FLAGS) --all-targets -- -D warnings
	RUSTDOCFLAGS="-D warnings" cargo doc $(CARGO_FLAGS) --no-deps
	$(BIN)/ruff check clients/python tests benches
	$(BIN)/ruff format --check clients/python tests benches

load: ## Puts load on the server of `make serve`: make load LOAD="--clients 32 --seconds 10"; LOAD=--help tells more.
	cargo run $(CARGO_FLAGS) --quiet --example load -- $(LOAD)

reliability: build venv reliability-tools ## The figures of docs/reliability.md: make reliability RELIABILITY="hostile overload"; RELIABILITY=--help tells more.
	cargo build $(CARGO_FLAGS) --examples
	$(BIN)/python -m tests.reliability $(RELIABILITY)

KILLS ?= 100
DURABILITY ?= process
chaos: ## Kills servers while sessions act, and looks for acts that are lost or given twice: make chaos KILLS=1000 DURABILITY=power
	cargo build $(CARGO_FLAGS) --bins --example chaos
	target/release/examples/chaos --kills $(KILLS) --durability $(DURABILITY)

SEEDS ?= 1000
SIMULATE ?=
simulate: ## The whole server in a simulated world, in stories that are drawn from seeds: make simulate SEEDS=20000; SIMULATE=--help tells more.
	cargo build $(CARGO_FLAGS) --example simulate
	target/release/examples/simulate --seeds $(SEEDS) $(SIMULATE)

MINUTES ?= 120
soak: build venv ## Hours of mixed work on one server, whose memory has to stay and whose counters have to add up: make soak MINUTES=120
	$(BIN)/python -m tests.soak --minutes $(MINUTES)

.PHONY: chaos simulate soak reliability-tools
reliability-tools: .venv-reliability/.ready
.venv-reliability/.ready: tests/reliability/requirements.txt | tools
	$(PYTHON) -m venv .venv-reliability
	.venv-reliability/bin/pip install --quiet --disable-pip-version-check -r $<
	touch $@

.PHONY: worlds
worlds: venv ## What experts earn in every environment, with and without sight of its context: make worlds WORLDS="--only blind cheetah-wind-s"
	$(BIN)/python -m tests.worlds $(WORLDS)

bench: ## Kernel, forward, act and training-step times of this machine.
	RAYON_NUM_THREADS=1 CANDLE_NUM_THREADS=1 MALLOC_MMAP_THRESHOLD_=1073741824 MALLOC_TRIM_THRESHOLD_=4294967296 cargo bench --locked

# PEERS_VENV may name a virtual environment that has the requirements already.
PEERS_VENV ?= .venv-peers
PEERS ?=
.PHONY: bench-peers
bench-peers: tools $(if $(filter .venv-peers,$(PEERS_VENV)),.venv-peers/.ready) ## Ratios to PyTorch and a Python policy server (downloads PyTorch, half an hour); PEERS=--help tells more.
	cargo build $(CARGO_FLAGS) --bins --examples
	$(PEERS_VENV)/bin/python benches/peers/compare.py $(PEERS)

.venv-peers/.ready: benches/peers/requirements.txt
	$(PYTHON) -m venv .venv-peers
	.venv-peers/bin/pip install --quiet --disable-pip-version-check -r $<
	touch $@

proto-python: tools ## Writes the Python stubs anew from proto/, with the lowest version that clients may have.
	$(PYTHON) -m venv target/proto-venv
	target/proto-venv/bin/pip install --quiet --disable-pip-version-check grpcio-tools==1.72.2
	target/proto-venv/bin/python -m grpc_tools.protoc -I proto --python_out=clients/python --grpc_python_out=clients/python --pyi_out=clients/python proto/ada_diffuser/v1/*.proto

# With --tests the features of the test dependencies count, as in `cargo test`: so one build serves both halves of `make test`.
.PHONY: build test-binaries venv
test-binaries: tools
	cargo build $(CARGO_FLAGS) --bins --tests

build: tools
	cargo build $(CARGO_FLAGS) --bins

venv: $(VENV)/.ready
$(VENV)/.ready: clients/python/requirements.lock clients/python/pyproject.toml | tools
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check -r clients/python/requirements.lock
	$(BIN)/pip install --quiet --disable-pip-version-check --no-deps -e clients/python
	touch $@

clean: ## Removes what was built.
	rm -rf target $(VENV) .venv-peers out
