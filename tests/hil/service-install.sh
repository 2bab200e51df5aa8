#!/bin/bash
# service-install.sh NAME: what the Debian package brings (Cargo.toml: metadata.deb), the board file of the folder NAME, and the
# service enabled, on a machine that is about to boot. The program is the one that tests are built with.
set -euo pipefail
cd "$(dirname "$(realpath "$0")")/../.."
sed -n '/^assets = \[/,/^\]/s/^ *\["\([^"]*\)", "\([^"]*\)", "\([0-7]*\)"\],*$/\1 \2 \3/p' Cargo.toml |
  while read -r from to mode; do
    for file in ${from/target\/release/target\/debug}; do
      case $to in */) to=${to%/}/; name=$to${file##*/};; *) name=$to;; esac
      install -D -m "$mode" "$file" "/$name"
    done
  done
install -D -m 644 board-configs/stipple.service /lib/systemd/system/stipple.service
sh board-configs/deb/postinst configure
mkdir -p /etc/stipple
cp "$1/board.toml" /etc/stipple/
(cd "$1" && find mav0 -name sensor.yaml -exec cp --parents {} /etc/stipple/ \;)
systemctl --root=/ enable stipple
# Where the machine waits for the host's files, its clock leaps, which a watchdog takes for silence: what is needed later is
# read before.
tools=$(command -v chrt getent journalctl stat systemctl)
driver=$(ls /usr/lib/*/libvulkan_lvp.so)
modules=$(modprobe -a -D vhci-hcd uvcvideo i2c-dev hil-imu gpio-sim | awk '/^insmod/{print $2}')
# shellcheck disable=SC2086
libraries=$(ldd /usr/bin/stipple $tools $driver | awk '/=> \//{print $3}' | sort -u)
find "$1" -type f ! -name '*.png' -exec cat {} + >/dev/null
# shellcheck disable=SC2086
cat $modules $libraries $tools $driver "$1"/../bin/hil{_service,-uvc-camera} >/dev/null
