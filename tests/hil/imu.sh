#!/bin/bash
# imu.sh TEST: GPIO, I2C, SPI and IIO as Debian's kernel has them: lines of gpio-sim, and hil-imu first for our register
# driver, then with the stock inv_mpu6050 on it.
set -euo pipefail
modprobe -a gpio-sim i2c-dev spidev inv-mpu6050-i2c
mountpoint -q /sys/kernel/config || mount -t configfs none /sys/kernel/config

# Lines of a chip "hil-gpio": 3 is the unit's data ready, 5 triggers cameras, 6 has no name.
sim=/sys/kernel/config/gpio-sim/hil
mkdir -p $sim/bank0/line3 $sim/bank0/line5
echo 8 >$sim/bank0/num_lines
echo imu-ready >$sim/bank0/line3/name
echo camera-trigger >$sim/bank0/line5/name
echo hil-gpio >$sim/bank0/label
echo 1 >$sim/live
HIL_LINES=/sys/devices/platform/$(cat $sim/dev_name)/$(cat $sim/bank0/chip_name)
export HIL_LINES

passes() { "$test" --ignored --test-threads=1 --nocapture "$@"; }
test=$1 status=0
export RUST_BACKTRACE=0
modprobe hil-imu
passes lines:: || status=1
passes registers:: || status=1
rmmod hil-imu
modprobe hil-imu bind=mpu6500 gpio_label=hil-gpio gpio_line=3
passes kernel:: || status=1
rmmod hil-imu
dmesg | grep -E 'BUG:|Oops|WARNING:' && status=1
exit $status
