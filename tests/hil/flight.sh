#!/bin/bash
# flight.sh TEST NAME: cameras over USB/IP and an inertial unit on I2C, played by TEST from the folder NAME, under `stipple`.
# What plays a device goes before programs, as hardware does.
set -euo pipefail
modprobe -a vhci-hcd uvcvideo i2c-dev hil-imu
. "${0%/*}/lines.sh"
# Where the machine waits for the host's files, its clock leaps: what the program is made of is read before.
program=${1%/*}/../../debug/stipple
ldd "$program" | awk '/=> \//{print $3}' | xargs cat "$program" >/dev/null
export HIL_UVC_CAMERA=${1%/*}/hil-uvc-camera HIL_FLIGHT=${1%/*}/../$2 RUST_BACKTRACE=0
flights=flight_
[ "$2" = flight ] || flights='flight_through_ map_'
# shellcheck disable=SC2086
chrt --fifo 50 "$1" --ignored --test-threads 1 --nocapture $flights && status=0 || status=1
[ $status = 0 ] || dmesg | grep -iE 'uvc|vhci|usb 1|BUG|WARNING' | tail -20
exit $status
