#!/bin/bash
# vivid.sh TESTS: the kernel's virtual camera with the multi-planar API. In the guest of run-vm.sh, started by run.
modprobe vivid n_devs=1 node_types=0x1 num_inputs=1 input_types=0 vid_cap_nr=0 multiplanar=2 || exit 1
"$1" --ignored --test-threads 1 --nocapture vivid_
status=$?
[ $status = 0 ] || v4l2-ctl -d /dev/video0 --list-ctrls
exit $status
