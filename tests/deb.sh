#!/bin/bash
# deb.sh [PACKAGE]: installs, upgrades and removes the package of `make deb` in a Debian 12 of its own, and looks at what is there after each.
# Needs root, debootstrap, the network at first, cargo-deb, and `make deb`.
set -euo pipefail
cd "$(dirname "$(realpath "$0")")/.."
root=$PWD/target/bare/bookworm
package=${1:-$(ls -t target/debian/stipple_*.deb | head -1)}

if [ ! -e "$root/done" ]; then
  rm -rf "$root"; mkdir -p "$root"
  debootstrap --variant=minbase --include=libvulkan1,mesa-vulkan-drivers,systemd,udev bookworm "$root" http://deb.debian.org/debian >"$root.log"
  touch "$root/done"
fi
inside() { unshare -m sh -c 'mount -t proc proc "$0/proc" && exec chroot "$0" env HOME=/root LC_ALL=C DEBIAN_FRONTEND=noninteractive "$@"' "$root" "$@"; }
fails() { echo "deb.sh: $*" >&2; exit 1; }
there() { for f; do [ -e "$root$f" ] || fails "$f is missing"; done; }
gone() { for f; do [ ! -e "$root$f" ] || fails "$f is left"; done; }
program=/usr/bin/stipple unit=/lib/systemd/system/stipple.service rules=/usr/lib/udev/rules.d/99-stipple.rules

inside dpkg --purge stipple >/dev/null 2>&1 || true
rm -rf "$root/etc/stipple" "$root/var/lib/stipple"
cp "$package" "$root/stipple.deb"
inside dpkg -i /stipple.deb || fails "it cannot be installed"
there $program $unit $rules /usr/share/stipple/board-configs/drone-pi5.toml
inside getent group stipple-sensors || fails "no group stipple-sensors"
inside stipple --version
inside systemd-analyze verify $unit || fails "the unit"
! inside systemctl is-enabled stipple || fails "it is enabled before there is a board file"
mkdir -p "$root/etc/stipple" "$root/var/lib/stipple/run"
cp board-configs/lavapipe.toml "$root/etc/stipple/board.toml"
echo kept >"$root/var/lib/stipple/run/kept"
inside stipple check --board /etc/stipple/board.toml | tail -1
inside systemctl enable stipple

next=$(mktemp -d)
dpkg-deb -R "$package" "$next/tree"
sed -i 's/^Version:.*/Version: 999.0-1/' "$next/tree/DEBIAN/control"
dpkg-deb -b "$next/tree" "$root/stipple.deb" >/dev/null
rm -rf "$next"
inside dpkg -i /stipple.deb || fails "it cannot be upgraded"
[ "$(inside dpkg-query -f '${Version}' -W stipple)" = 999.0-1 ] || fails "the version after the upgrade"
there $program $unit $rules /etc/stipple/board.toml /var/lib/stipple/run/kept
inside systemctl is-enabled stipple || fails "the upgrade disabled it"

inside dpkg -r stipple
gone $program $unit $rules /usr/share/stipple
there /etc/stipple/board.toml /var/lib/stipple/run/kept
inside dpkg --purge stipple
there /etc/stipple/board.toml /var/lib/stipple/run/kept
! inside systemctl is-enabled stipple || fails "it is enabled after it was purged"
left=$(cd "$root" && find etc/systemd lib/systemd usr/lib/systemd var/lib/systemd -name '*stipple*' 2>/dev/null || true)
[ -z "$left" ] || fails "left: $left"
echo "deb.sh: installed, upgraded, removed and purged"
