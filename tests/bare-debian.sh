#!/bin/bash
# bare-debian.sh [PROGRAM]: the release build on a Debian 13 that has Vulkan and nothing else: neither libgpiod nor OpenCV. Built with
# Debian 12's libraries, it must start there, fly and map with `sgm` in the place of OpenCV, and say what a GPIO line needs.
# Needs root, debootstrap (apt-get install debootstrap), the network at first, and `cargo build --release`.
set -euo pipefail
cd "$(dirname "$(realpath "$0")")/.."
root=$PWD/target/bare/trixie
program=${1:-target/release/stipple}

if [ ! -e "$root/done" ]; then
  rm -rf "$root"; mkdir -p "$root"
  debootstrap --variant=minbase --include=mesa-vulkan-drivers,libvulkan1 trixie "$root" http://deb.debian.org/debian >"$root.log"
  touch "$root/done"
fi
mkdir -p "$root/opt/stipple"
cp "$program" board-configs/lavapipe.toml "$root/opt/stipple/"
# No device of this machine's is seen: Vulkan is Mesa's, on the CPU.
inside() {
  unshare -m sh -c 'mount -t proc proc "$0/proc" && exec chroot "$0" env -C /opt/stipple HOME=/opt/stipple "$@"' "$root" "$@"
}
fails() { echo "bare-debian.sh: $*" >&2; exit 1; }

echo "Debian $(cat "$root/etc/debian_version"), $(inside dpkg-query -f '.\n' -W | wc -l) packages"
! inside ldconfig -p | grep -E 'gpiod|opencv' || fails "the root is not bare"
! inside ldd ./stipple | grep -E 'gpiod|opencv|not found' || fails "the program needs more than it may"
inside rm -rf flight out demo
inside ./stipple sim demo --duration 3 --out flight 2>&1 | tail -1
said=$(inside ./stipple replay flight --board lavapipe.toml --scale 2 --pace lockstep --out out 2>&1) || fails "the flight: $said"
grep -v '^[0-9]' <<<"$said" # without the lines of progress
[ "$(grep -c 'sgm. matches in its place' <<<"$said")" = 1 ] || fails "no warning, or more than one"
[ -s "$root/opt/stipple/out/map.ply" ] || fails "no map"
inside ./stipple demo --board lavapipe.toml --out demo >/dev/null 2>&1 || fails "the demo"
[ -s "$root/opt/stipple/demo/report.html" ] || fails "no report of the demo"
said=$(inside ./stipple run --board lavapipe.toml --set gpio.led=gpiochip0:3 --out none 2>&1) && fails "a LED without libgpiod"
grep 'apt install libgpiod3' <<<"$said" || fails "the LED: $said"
