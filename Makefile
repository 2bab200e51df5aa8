# Two commands for a newcomer on Debian 12 with git, make and a Rust toolchain:
#   make demo    fly and map a simulated room, write out/demo/report.html
#   make test    run the tests that need neither hours nor other hardware
# Both install what is missing (the list below, with sudo when not root) and say so.

# The one place where Debian packages are listed:
#   g++                    linker, and the compiler of the OpenCV shim
#   glslang-tools          GLSL -> SPIR-V in the build
#   libopencv-calib3d-dev  block matching; its libraries are loaded where a board asks for it
#   libvulkan1             Vulkan loader
#   mesa-vulkan-drivers    lavapipe (Vulkan on the CPU), and the drivers of Intel, AMD and Pi GPUs
#   python3-pip            fetches the other ends of what talks to an autopilot (tests/autopilot), of maps (tests/export) and of ROS (src/bridge)
#   systemd                judges the unit of the service in the tests
#   vulkan-validationlayers  the tests run the pipeline under the Khronos validation layer
PACKAGES := g++ glslang-tools libopencv-calib3d-dev libvulkan1 mesa-vulkan-drivers python3-pip systemd vulkan-validationlayers

# What `make hil` needs besides: a machine to emulate, and the headers of the kernel it boots.
#   qemu-system-x86 busybox-static cpio kmod xz-utils  the machine and its first file system
#   linux-headers-amd64    builds the modules that Debian does not (tests/hil/prepare.sh)
#   gpiod                  brings libgpiod2
#   i2c-tools v4l-utils    what a failing test is looked into with, with gpiod's own tools
#   udev                   gives the sensors' nodes to the groups of the service, as on a vehicle
HIL_PACKAGES := busybox-static cpio gpiod i2c-tools kmod linux-headers-amd64 qemu-system-x86 udev v4l-utils xz-utils

OUT ?= out/demo

.PHONY: demo test bridge test-bridge deb hil test-onnx soak fuzz bench-odometry lint deps

demo: deps
	cargo build --release --locked
	target/release/stipple demo --board board-configs/lavapipe.toml --out $(OUT)

test: deps
	@$(MAKE) --no-print-directory target/python/pymavlink || echo "left out: the tests of tests/program/autopilot.rs, since pip could not fetch pymavlink"
	@$(MAKE) --no-print-directory target/python/gaussforge || echo "left out: the test of tests/program/export.rs with a foreign reader, since pip could not fetch gaussforge"
	cargo check --locked --no-default-features
	cargo test --workspace --locked --no-fail-fast
	@$(MAKE) --no-print-directory test-onnx
	@$(MAKE) --no-print-directory test-bridge

target/python/pymavlink: tests/autopilot/requirements.txt
	python3 -m pip install --quiet --upgrade --target target/python --requirement $<
	@touch $@

target/python/gaussforge: tests/export/requirements.txt
	python3 -m pip install --quiet --upgrade --target target/python --requirement $<
	@touch $@

# The bridge to ROS 2 (src/bridge), a package apart: target/bridge/release/stipple-bridge. Its dependencies take minutes to build.
BRIDGE := CARGO_TARGET_DIR=target/bridge cargo
BRIDGE_MANIFEST := --manifest-path src/bridge/Cargo.toml

bridge: deps
	$(BRIDGE) build --release --locked $(BRIDGE_MANIFEST)

test-bridge:
	@$(MAKE) --no-print-directory target/python-dds/cyclonedds || echo "left out: the tests of src/bridge/tests with Cyclone DDS, which pip could not fetch"
	$(BRIDGE) test --locked --no-fail-fast $(BRIDGE_MANIFEST)

target/python-dds/cyclonedds: src/bridge/tests/requirements.txt
	python3 -m pip install --quiet --upgrade --target target/python-dds --requirement $<
	@touch $@

# A Debian package, in target/debian. Needs dpkg-dev, and builds cargo-deb first where it is missing.
deb: deps
	command -v cargo-deb >/dev/null || cargo install --locked cargo-deb
	cargo deb --locked --strip

# The drivers on the real V4L2, USB, I2C, SPI, IIO and GPIO of Debian's kernel, emulated: minutes. TESTS="uvc" runs some.
hil:
	@$(MAKE) --no-print-directory deps PACKAGES="$(PACKAGES) $(HIL_PACKAGES)"
	tests/hil/prepare.sh
	tests/hil/run $(TESTS)

# The tests that ONNX Runtime must be there for. Debian 12 does not package it; pip has it.
test-onnx:
	@lib=$${STIPPLE_ONNXRUNTIME:-$$(ls target/onnxruntime/onnxruntime/capi/libonnxruntime.so.* 2>/dev/null | head -1)}; \
	if [ -z "$$lib" ]; then \
	  python3 -m pip install --quiet --no-deps --target target/onnxruntime onnxruntime 2>/dev/null; \
	  lib=$$(ls target/onnxruntime/onnxruntime/capi/libonnxruntime.so.* 2>/dev/null | head -1); fi; \
	if [ -n "$$lib" ]; then STIPPLE_ONNXRUNTIME=$$(realpath $$lib) cargo test --locked --test onnx -- --ignored; \
	else echo "left out: the tests of tests/onnx.rs that need ONNX Runtime, which pip could not fetch"; fi

# A minute of garbage for the tracker and the estimator, then MINUTES of a run SPEED times as fast as life, whose memory, files
# and threads are watched. The two hours of a release: MINUTES=24. Where tracking cannot keep up, a lower SPEED.
MINUTES ?= 5
SPEED ?= 5
soak: deps
	STIPPLE_SOAK_MINUTES=$(MINUTES) STIPPLE_SOAK_SPEED=$(SPEED) cargo test --locked --test soak -- --ignored --nocapture --test-threads 1

# Inputs guided by coverage for everything that reads files of strangers, SECONDS each. TARGETS="tables image" are some.
SECONDS ?= 60
fuzz: deps
	tests/fuzz/run $(SECONDS) $(TARGETS)

# Times of each stage of tracker and estimator, and frames a second on one thread and on two; a minute and a half.
bench-odometry: deps
	cargo run --release --locked --features instruments --bin stipple-bench -- stages --out out/stages

lint:
	cargo fmt --all --check
	cargo clippy --workspace --all-targets --locked -- -D warnings
	cargo clippy --locked --bin stipple -- -D warnings
	cargo fmt --manifest-path tests/fuzz/Cargo.toml --check
	CARGO_TARGET_DIR=target cargo clippy --locked --manifest-path tests/fuzz/Cargo.toml -- -D warnings
	cargo fmt $(BRIDGE_MANIFEST) --check
	$(BRIDGE) clippy --all-targets --locked $(BRIDGE_MANIFEST) -- -D warnings

deps:
	@missing=; for p in $(PACKAGES); do \
	  dpkg-query -W -f='$${Status}' $$p 2>/dev/null | grep -q 'ok installed' || missing="$$missing $$p"; done; \
	if [ -n "$$missing" ]; then \
	  echo "installing:$$missing"; \
	  as=; [ "$$(id -u)" = 0 ] || as=sudo; \
	  $$as apt-get update -qq && DEBIAN_FRONTEND=noninteractive $$as apt-get install -y -qq --no-install-recommends $$missing; fi
