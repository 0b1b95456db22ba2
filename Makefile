# fourdbody: each target installs the Debian packages that it needs and that are missing, and says so.
#
#   make demo      simulator, two nodes, one session, verified, reconstructed and scored
#   make lab       eight simulated cameras, HSU, two nodes and a body that walks: the console to try, with faults to type
#   make test      everything that can be tested on this machine
#   make check     after a change: does everything compile, and do the tests beside the code pass
#   make lint      formatting and lints, all fatal; with make deny
#   make deny      licences, sources and versions of the dependencies
#   make bench-ingest          a node with four cameras at full rate, to disk (22 GB for a moment)
#   make bench-ingest LONG=1   five minutes of it, finished segments dropped as it goes
#   make bench-reconstruct     milliseconds a frame, stage by stage, beside other programs (PEERS=0 leaves these out)
#   make bench-live            the live body beside a recording: frame sets a second, light to screen, frames lost
#   make bench-before-record   frames of five seconds held until Record, at full rate: memory, losses
#   make bench-play            what it costs a browser to play 1200 frame sets: memory, first picture, seeks
#   make bench-worker          frame sets an hour with reading, verifying and writing, beside the reconstruction itself
#   make poses     fringe orders on 224 camera frames of moving mannequins; BATTERY=held_out_again or bodies: of others
#   make geometry  fringe orders at other distances, volumes, periods, heads and cameras a head
#   make drift     what `calibration check` finds where devices have turned or shifted, and what its correction is worth
#   make noise     the same with half a grey value of noise (NOISE_DN)
#   make light     striped shirts, tattoos, little and too much light, defocus, devices that have turned
#   make real      photographs that others took, against what others make of many (fetched, or named as skipped)
#   make validate  the paper's section 5: calibrated, Table 3, girths, spacing, beside the paper's figures
#   make figures   every figure of README.md and docs, measured and written there; scripts/figures.sh prints the minutes
#   make fuzz      every fuzz target for FUZZ_SECONDS (nightly compiler)
#   make deb       the Debian package, in target/debian; scripts/try-package.sh tries it in a clean Debian
#   make release   the package with SHA256SUMS, of a clean tree whose documents are of this version
#   make wheel     the Python package, in target/wheels
#   make python    the same, and its tests and notebooks on what `make demo` wrote
#   make firmware  the HSU's firmware for a Raspberry Pi Pico, and its bench in emulated time (TRIGGERS: 1000)
#   make python-docs    its pages, made from the docstrings, in target/python-docs
#   make third-party   others' programs that take minutes to build

SHELL := /bin/bash
CARGO ?= cargo
export CARGO_TERM_COLOR ?= auto

.PHONY: all demo lab test check lint deny deb bench-ingest bench-reconstruct bench-live bench-play bench-before-record bench-worker matrix poses geometry drift noise light real validate figures packages test-packages clean-out fuzz third-party release wheel python python-docs firmware

all: packages
	$(CARGO) build --release --workspace

# Aravis' development package does not depend on everything that its pkg-config file names.
packages:
	@scripts/install-packages.sh gcc pkg-config libaravis-dev libusb-1.0-0-dev

# Readers of our files that are not ours. Open3D (600 MB installed) is left out; the tests use it where it is found:
# FOURDBODY_TEST_PYTHON=PYTHON of an environment with $(READERS) open3d-cpu==0.20.0 pymeshlab pyvista.
READERS := mcap==1.6.0 mcap-protobuf-support==0.5.3 numpy==2.4.6 trimesh==5.2.0 plyfile==1.1.5 pypcd4==1.5.1 \
	pye57==0.4.19 pygltflib==1.16.5 pillow==13.0.0 tifffile==2026.3.3 opencv-python-headless==5.0.0.93

# EMVA's reference of GenICam, which says what a camera's registers really hold.
GENICAM := genicam==1.6.0

# Third parties that the tests talk to; a test whose program is absent says so and is skipped.
test-packages: packages
	@scripts/install-packages.sh aravis-tools aravis-tools-cli python3-venv tshark chromium chromium-driver slurm-wlm munge \
		ffmpeg
	@scripts/make-venv.sh tests/.venv $(READERS)
	@scripts/make-venv.sh tests/.venv-genicam $(GENICAM)
	@scripts/install-tool.sh s3s-fs 0.14.1 --debug --features binary

demo: packages
	$(CARGO) build --release --workspace
	scripts/demo.sh

lab: packages
	$(CARGO) build --release --workspace
	target/release/fourdbody-sim lab --dir target/lab

# Not what `make lint` compiles anyway: the tests without Aravis, and the examples.
test: test-packages
	scripts/test.sh

check: packages
	$(CARGO) fmt --all -- --check
	$(CARGO) fmt --manifest-path python/Cargo.toml -- --check
	$(CARGO) fmt --manifest-path firmware/Cargo.toml -- --check
	$(CARGO) test --workspace --lib
	$(CARGO) check --workspace --all-targets

lint: packages
	$(CARGO) fmt --all -- --check
	$(CARGO) fmt --manifest-path python/Cargo.toml -- --check
	$(CARGO) fmt --manifest-path firmware/Cargo.toml -- --check
	$(CARGO) clippy --workspace --all-targets -- -D warnings
	$(CARGO) clippy --no-default-features --all-targets -- -D warnings
	scripts/deny.sh

deny:
	scripts/deny.sh

# fio and arv-camera-test-0.8 are what the node is compared with; ethtool tells loopback to cut segmented sends.
bench-ingest: packages
	@scripts/install-packages.sh aravis-tools fio ethtool
	$(CARGO) build --release --workspace
	$(CARGO) build --release --workspace --example ingest_buffered
	scripts/bench-ingest.sh

bench-reconstruct: packages
	@scripts/install-packages.sh python3-venv
	$(CARGO) build --release --workspace
	$(CARGO) build --release --workspace --example wrapped_phase
	scripts/bench-reconstruct.sh

bench-live: demo
	@scripts/install-packages.sh chromium chromium-driver python3
	scripts/bench-live.sh

bench-before-record: packages
	@scripts/install-packages.sh curl python3
	$(CARGO) build --release --workspace
	scripts/bench-before-record.sh

bench-play: demo
	@scripts/install-packages.sh chromium chromium-driver curl python3
	scripts/bench-play.sh

bench-worker: demo
	scripts/bench-worker.sh

# Every table of a real camera in every state: target/matrix/summary.json. DESCRIPTIONS=DIR: published descriptions, XML or
# zipped, too; what is set is judged by EMVA's own GenApi, and by make in target/matrix/makes.md.
DESCRIPTIONS ?=
matrix: packages
	@scripts/install-packages.sh python3-venv
	@scripts/make-venv.sh tests/.venv-genicam $(GENICAM)
	FOURDBODY_MATRIX=$(CURDIR)/target/matrix/summary.json FOURDBODY_DESCRIPTIONS=$(abspath $(DESCRIPTIONS)) \
	  $(CARGO) test -p fourdbody --test it -- matrix:: --nocapture

poses: packages
	$(CARGO) build --release --workspace
	scripts/poses.sh

geometry: packages
	$(CARGO) build --release --workspace
	python3 scripts/geometry.py

drift: packages
	$(CARGO) build --release --workspace
	python3 scripts/drift.py

noise: packages
	$(CARGO) build --release --workspace
	scripts/noise.sh

light: packages
	$(CARGO) build --release --workspace
	scripts/light.sh

real: packages
	@scripts/install-packages.sh python3-venv
	$(CARGO) build --release --workspace --bin fourdbody --example wrapped_phase
	scripts/real.sh

validate: packages
	$(CARGO) build --release --workspace
	scripts/validate.sh

figures: packages
	scripts/figures.sh

deb: packages
	@scripts/install-packages.sh dpkg-dev
	@scripts/install-tool.sh cargo-deb 3.6.2
	$(CARGO) build --release --workspace
	$(CARGO) run --release --example manual -- target/manual
	target/tools/bin/cargo-deb --no-build -o target/debian/

wheel: packages
	@scripts/install-packages.sh python3-venv
	scripts/python.sh

python: demo
	@scripts/install-packages.sh python3-venv
	TEST=1 scripts/python.sh

python-docs: packages
	@scripts/install-packages.sh python3-venv
	@scripts/make-venv.sh target/mkdocs mkdocs==1.6.1 mkdocstrings==1.0.8 mkdocstrings-python==2.0.11
	target/mkdocs/bin/mkdocs build --quiet --config-file python/mkdocs.yml

firmware:
	scripts/firmware.sh

release: packages
	scripts/release.sh

FUZZ_SECONDS ?= 180
fuzz: packages
	scripts/fuzz.sh $(FUZZ_SECONDS)

third-party: packages
	scripts/third-party.sh
