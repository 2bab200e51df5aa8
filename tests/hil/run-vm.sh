#!/bin/bash
# run-vm.sh [options] [--] CMD [ARGS...]
# Boots the kernel that prepare.sh unpacked under QEMU, with this machine's root file system below a memory overlay (what
# CMD writes is lost, save in $OUT), runs CMD there as root, relays its output and ends with its exit status.
#
#   -t SECONDS   give up after so much wall time (default 300) with status 124
#   -m MIB       memory (default 2048)
#   -s CPUS      processors (default 1: under emulation wake-ups across processors are some 15 times slower)
#   -i           time is work: the machine's clock counts its instructions, one a nanosecond, and leaps over idleness, so
#                that what runs there meets its times however slow the host is; one processor
#   -w N         with -i: N instructions a nanosecond, by a kernel that is told that its counter of cycles runs N times as
#                fast: a machine N times as fast to what runs there, in N times the wall time of what keeps it busy
#   -S           boot systemd of the shared root as PID 1, up to multi-user.target with what Debian starts there and nothing
#                that was installed besides; CMD runs as a unit of its own
#   -P COMMAND   with -S: a shell command that runs before systemd does, as one installs on an image
#   -o FOLDER    mounted read-write at /out in the guest, $OUT there (default: a temporary folder)
#   -A "ARGS"    more of the kernel's command line
#   -q "ARGS"    more arguments of QEMU
# HIL: where prepare.sh wrote (target/hil). HIL_ACCEL: tcg (default), kvm, or auto. HIL_LOCK: one VM at a time holds it.
# Status 125: the machine ended without one; console.log in the folder of -o says why.
# Needs qemu-system-x86 busybox-static cpio kmod xz-utils.
set -euo pipefail
here=$(dirname "$(realpath "$0")")
HIL=${HIL:-$(realpath "$here/../..")/target/hil}
accel=${HIL_ACCEL:-tcg} memory=2048 cpus=1 seconds=300 out= counted=0 work=1 systemd=0 install=true qemu_more= append_more=
usage() { sed -n 2,21p "$0"; exit 2; }
while getopts t:m:s:iw:SP:o:A:q: option; do case $option in
  t) seconds=$OPTARG;; m) memory=$OPTARG;; s) cpus=$OPTARG;; i) counted=1;; w) work=$OPTARG;; S) systemd=1;; P) install=$OPTARG;;
  o) out=$OPTARG;; A) append_more=$OPTARG;; q) qemu_more=$OPTARG;; *) usage;; esac; done
shift $((OPTIND-1)); [ $# -gt 0 ] || usage
kernel=$HIL/kernel
[ -d "$kernel/lib/modules" ] || { echo "run-vm.sh: no kernel in $kernel: run tests/hil/prepare.sh first" >&2; exit 2; }
version=$(basename "$kernel"/lib/modules/*)
if [ -z "$out" ]; then out=$(mktemp -d); trap 'rm -rf "$out"' EXIT; fi
mkdir -p "$out"; out=$(realpath "$out"); rm -f "$out"/{rc,cmd.sh,console.log}

# Once for each kernel and each change of a module or of this file: dependencies of modules, an image that needs no slow
# decompression, and an initial file system that mounts the rest.
exec 9>"$HIL/lock"; flock 9
modules=$kernel/lib/modules/$version
mkdir -p "$modules/extra"
for ko in "$HIL"/ko/*.ko; do
  [ -e "$ko" ] || continue
  cmp -s "$ko" "$modules/extra/${ko##*/}" || { cp "$ko" "$modules/extra/"; rm -f "$modules/modules.dep"; }
done
[ -s "$modules/modules.dep" ] || depmod -b "$kernel" "$version"
if [ ! -s "$HIL/vmlinux-$version" ]; then
  # As scripts/extract-vmlinux of the kernel does: the compressed image starts at one of these magic numbers.
  packed=$kernel/boot/vmlinuz-$version
  for method in '\xFD7zXZ\x00|xz -dc' '\x28\xB5\x2F\xFD|zstd -dcq' '\x1f\x8b\x08|gzip -dc'; do
    for at in $(LC_ALL=C grep -obUaP "${method%%|*}" "$packed" | cut -d: -f1); do
      tail -c+$((at+1)) "$packed" | ${method#*|} >"$HIL/vmlinux.part" 2>/dev/null || true
      [ "$(head -c4 "$HIL/vmlinux.part" | tail -c3)" = ELF ] && { mv "$HIL/vmlinux.part" "$HIL/vmlinux-$version"; break 2; }
    done
  done
  rm -f "$HIL/vmlinux.part"
  [ -s "$HIL/vmlinux-$version" ] || cp "$packed" "$HIL/vmlinux-$version"
fi
if [ ! -s "$HIL/initrd-$version" ] || [ "$0" -nt "$HIL/initrd-$version" ]; then
  root=$HIL/initrd; rm -rf "$root"; mkdir -p "$root"/{bin,lib/m,proc,sys,dev,lower,rw,new}
  cp /bin/busybox "$root/bin/busybox"
  for applet in sh mount umount insmod mkdir ln cat switch_root echo poweroff reboot sleep mknod; do
    ln -s busybox "$root/bin/$applet"
  done
  : >"$root/lib/order"
  for module in virtio_pci virtio_console 9pnet_virtio 9p overlay; do
    # modprobe -D prints insmod lines in the order of dependencies.
    modprobe -d "$kernel" -S "$version" -D "$module" 2>/dev/null | awk '/^insmod/{print $2}' | while read -r ko; do
      name=$(basename "$ko")
      [ -e "$root/lib/m/$name" ] || { cp "$ko" "$root/lib/m/"; echo "$name" >>"$root/lib/order"; }
    done
  done
  cat >"$root/init" <<'INIT'
#!/bin/sh
mount -t proc proc /proc; mount -t sysfs sys /sys; mount -t devtmpfs dev /dev
while read m; do insmod /lib/m/$m || echo "insmod $m failed"; done </lib/order
O=trans=virtio,version=9p2000.L,msize=512000
mount -t 9p -o ro,cache=loose,$O hostroot /lower || exec reboot -f
mount -t tmpfs -o size=75%,mode=755 tmpfs /rw; mkdir -p /rw/u /rw/w
mount -t overlay -o lowerdir=/lower,upperdir=/rw/u,workdir=/rw/w overlay /new || exec reboot -f
mkdir -p /new/out /new/proc /new/sys /new/dev /new/run
mount -t 9p -o rw,cache=none,$O out /new/out
mount --move /proc /new/proc; mount --move /sys /new/sys; mount --move /dev /new/dev
mount -t tmpfs -o mode=755 tmpfs /new/run
exec switch_root /new /bin/sh /out/boot.sh
INIT
  chmod +x "$root/init"
  (cd "$root" && find . | cpio -o -H newc --quiet | gzip -1) >"$HIL/initrd.part"
  mv "$HIL/initrd.part" "$HIL/initrd-$version"; rm -rf "$root"
fi
flock -u 9

# What the guest runs: boot.sh prepares, cmd.sh is CMD.
printf -v command '%q ' "$@"
printf -v folder '%q' "$PWD"
cat >"$out/cmd.sh" <<EOF2
#!/bin/bash
cd $folder
export OUT=/out HOME=/root PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin
$command
EOF2
cat >"$out/boot.sh" <<EOF2
export PATH=/usr/sbin:/usr/bin:/sbin:/bin
mkdir -p /dev/pts /dev/shm; mount -t devpts devpts /dev/pts; mount -t tmpfs shm /dev/shm
mount -t debugfs debugfs /sys/kernel/debug 2>/dev/null
mount -t cgroup2 cgroup2 /sys/fs/cgroup 2>/dev/null
# The unpacked kernel's modules, over whatever this machine has.
mkdir -p /lib/modules; mount -t tmpfs tmpfs /lib/modules; mkdir /lib/modules/$version
for f in "$modules"/*; do ln -s "\$f" /lib/modules/$version/; done
hostname hil-vm 2>/dev/null; ip link set lo up 2>/dev/null
P=/dev/vport0p1
for i in 1 2 3 4 5 6 7 8 9 10; do
  for v in /sys/class/virtio-ports/*; do
    [ "\$(cat \$v/name 2>/dev/null)" = hil.out ] && P=/dev/\${v##*/} && break 2
  done; sleep 0.05
done
if [ $systemd = 1 ]; then
  umount /sys/fs/cgroup 2>/dev/null
  # In the overlay only: no marker of a container, no first boot, no fstab, no unit that this machine's owner installed, no
  # rebuilding of indices, and tmpfiles leaves the temporary folder.
  rm -f /.dockerenv /run/.containerenv; : >/etc/fstab
  rm -rf /etc/systemd/system/*.wants /etc/systemd/system/*.requires
  [ -s /etc/machine-id ] || echo 0123456789abcdef0123456789abcdef >/etc/machine-id
  touch /etc/.updated /var/.updated
  mkdir -p /etc/tmpfiles.d; ln -sf /dev/null /etc/tmpfiles.d/tmp.conf
  for u in systemd-binfmt.service proc-sys-fs-binfmt_misc.automount systemd-pcrphase-sysinit.service dev-hugepages.mount; do
    ln -sf /dev/null /etc/systemd/system/\$u; done
  (cd $folder; $install) >\$P 2>&1 </dev/null || { echo 2 >/out/rc; sync; reboot -f; }
  mkdir -p /run/systemd/system/multi-user.target.wants
  ln -s ../hil-cmd.service /run/systemd/system/multi-user.target.wants/
  cat >/run/systemd/system/hil-cmd.service <<U
[Unit]
After=basic.target dbus.socket
[Service]
Type=exec
StandardOutput=file:\$P
StandardError=inherit
ExecStart=/bin/bash -c '/bin/bash /out/cmd.sh; echo \\\$\\\$? >/out/rc; sync; systemctl reboot -ff'
U
  exec /lib/systemd/systemd --unit=multi-user.target --show-status=no --log-target=kmsg --log-level=info
fi
/bin/bash /out/cmd.sh >\$P 2>&1 </dev/null
echo \$? >/out/rc
sync
echo 1 >/proc/sys/kernel/sysrq; echo b >/proc/sysrq-trigger
EOF2

[ "$accel" != auto ] || { accel=tcg; [ -w /dev/kvm ] && grep -qwE 'vmx|svm' /proc/cpuinfo && accel=kvm; }
[ $counted = 0 ] || accel=tcg,thread=single qemu_more="-icount shift=0,sleep=off $qemu_more"
[ "$work" = 1 ] || append_more="tsc_early_khz=${work}000000 tsc=reliable $append_more"
case $accel in kvm*) cpu=host;; *) cpu=max,-erms,-fsrm; [ "$accel" != tcg ] || accel=tcg,thread=multi;; esac
# Emulation takes whole cores: machines wait for each other.
exec 8>"${HIL_LOCK:-$HIL/vm.lock}"; flock 8
status=0
# shellcheck disable=SC2086
timeout -k 5 "$seconds" qemu-system-x86_64 -machine q35,hpet=off -accel "$accel" -cpu "$cpu" -m "$memory" -smp "$cpus" \
  -nodefaults -no-user-config -display none -no-reboot -rtc base=utc,clock=host \
  -serial "file:$out/console.log" -kernel "$HIL/vmlinux-$version" -initrd "$HIL/initrd-$version" \
  -append "console=ttyS0 loglevel=4 panic=-1 reboot=t mitigations=off nokaslr random.trust_cpu=on ipv6.disable=1 $append_more" \
  -virtfs "local,path=/,mount_tag=hostroot,security_model=none,readonly=on,multidevs=remap" \
  -virtfs "local,path=$out,mount_tag=out,security_model=none" \
  -device virtio-serial-pci -chardev file,id=so,path=/dev/fd/3,append=on -device virtserialport,chardev=so,name=hil.out \
  -device virtio-rng-pci $qemu_more </dev/null 2>"$out/qemu.err" 3> >(exec cat) || status=$?
if [ $status = 124 ] || [ $status = 137 ]; then
  echo "run-vm.sh: timed out after $seconds s" >&2; tail -5 "$out/console.log" >&2; exit 124
fi
[ ! -s "$out/rc" ] || exit "$(cat "$out/rc")"
echo "run-vm.sh: the machine ended without a status (QEMU's is $status)" >&2
cat "$out/qemu.err" >&2; tail -30 "$out/console.log" >&2; exit 125
