#!/bin/bash
# uvc.sh TESTS: two UVC cameras over USB/IP, the kernel's own uvcvideo. In the guest of run-vm.sh, started by run.
modprobe vhci-hcd && modprobe uvcvideo || exit 1
export HIL_UVC_CAMERA=${1%/*}/hil-uvc-camera
"$1" --ignored --test-threads 1 --nocapture uvc_
status=$?
[ $status = 0 ] || dmesg | grep -iE 'uvc|vhci|usb 1' | tail -20
exit $status
