#!/bin/bash
# service.sh TEST NAME: cameras over USB/IP and an inertial unit on I2C, played by TEST from the folder NAME, under the service
# that service-install.sh installed. What plays a device goes before programs, as hardware does.
set -euo pipefail
modprobe -a vhci-hcd uvcvideo i2c-dev hil-imu
. "${0%/*}/lines.sh"
export HIL_UVC_CAMERA=${1%/*}/hil-uvc-camera HIL_FLIGHT=${1%/*}/../$2
chrt --fifo 50 "$1" --ignored --test-threads 1 --nocapture --skip prepare && status=0 || status=1
journalctl -b --no-pager -o short-monotonic >"$OUT/journal"
exit $status
