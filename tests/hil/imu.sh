#!/bin/bash
# imu.sh TEST: GPIO, I2C, SPI and IIO as Debian's kernel has them: lines of gpio-sim, and hil-imu first for our register
# driver, then with the stock inv_mpu6050 on it.
set -euo pipefail
modprobe -a i2c-dev spidev inv-mpu6050-i2c
. "${0%/*}/lines.sh"

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
