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
# Where the machine waits for the host's files, its clock leaps: what is needed later is read before.
libraries=$(ldd /usr/bin/stipple /usr/bin/systemctl /usr/bin/journalctl /usr/lib/*/libvulkan_lvp.so | awk '/=> \//{print $3}' | sort -u)
find "$1" -type f ! -name '*.png' -exec cat {} + >/dev/null
# shellcheck disable=SC2086
cat $libraries /usr/lib/*/libvulkan_lvp.so /usr/bin/{systemctl,journalctl} "$1"/../bin/hil{_service,-uvc-camera} "$1"/../ko/* >/dev/null
