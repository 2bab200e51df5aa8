# lines.sh: lines of a chip "hil-gpio" that gpio-sim makes: 3 is an inertial unit's data ready, 5 triggers cameras, 6 has no
# name. Sourced in the guest; HIL_LINES is where they are pulled.
modprobe gpio-sim
mountpoint -q /sys/kernel/config || mount -t configfs none /sys/kernel/config
sim=/sys/kernel/config/gpio-sim/hil
mkdir -p $sim/bank0/line3 $sim/bank0/line5
echo 8 >$sim/bank0/num_lines
echo imu-ready >$sim/bank0/line3/name
echo camera-trigger >$sim/bank0/line5/name
echo hil-gpio >$sim/bank0/label
echo 1 >$sim/live
HIL_LINES=/sys/devices/platform/$(cat $sim/dev_name)/$(cat $sim/bank0/chip_name)
export HIL_LINES
