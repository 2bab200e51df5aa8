#!/bin/bash
# colour.sh TEST NAME: cameras in colour over USB/IP and an inertial unit on I2C, played by TEST from the folder NAME, under
# `stipple`. What plays a device goes before programs, as hardware does.
set -euo pipefail
modprobe -a vhci-hcd uvcvideo i2c-dev hil-imu
. "${0%/*}/lines.sh"
# Where the machine waits for the host's files, its clock leaps: what the program is made of is read before.
program=${1%/*}/../../debug/stipple
driver=$(ls /usr/lib/*/libvulkan_lvp.so)
# shellcheck disable=SC2086
ldd "$program" $driver | awk '/=> \//{print $3}' | sort -u | xargs cat "$program" $driver >/dev/null
export HIL_UVC_CAMERA=${1%/*}/hil-uvc-camera HIL_FLIGHT=${1%/*}/../$2
chrt --fifo 50 "$1" --ignored --test-threads 1 --nocapture --skip prepare && status=0 || status=1
[ $status = 0 ] || dmesg | grep -iE 'uvc|vhci|usb 1|BUG|WARNING' | tail -20
exit $status
