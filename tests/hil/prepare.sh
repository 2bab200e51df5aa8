#!/bin/bash
# prepare.sh: what the virtual machine of these tests is made of, from Debian 12 packages alone: the kernel that belongs to
# the installed headers (unpacked, never installed) and the modules Debian does not build. Nothing is loaded here.
# Result: $HIL (target/hil by default) with kernel/ and ko/; done again only where a source is newer. `make hil` calls it.
set -euo pipefail
here=$(dirname "$(realpath "$0")")
HIL=${HIL:-$(realpath "$here/../..")/target/hil}
headers=$(ls -d /usr/src/linux-headers-*-amd64 2>/dev/null | sort -V | tail -1)
[ -n "$headers" ] || { echo "prepare.sh: no kernel headers: apt-get install linux-headers-amd64" >&2; exit 1; }
version=${headers#/usr/src/linux-headers-}
mkdir -p "$HIL"/{deb,ko,mods}
exec 9>"$HIL/lock"; flock 9

if [ ! -e "$HIL/kernel/boot/vmlinuz-$version" ]; then
  (cd "$HIL/deb" && rm -f linux-image-*.deb && apt-get download -qq "linux-image-$version")
  rm -rf "$HIL/kernel"; dpkg -x "$HIL"/deb/linux-image-*.deb "$HIL/kernel"
fi

# module NAME: builds mods/NAME, whose sources are in place, unless its result is newer than all of them.
module() {
  local ko=$HIL/ko/$1.ko dir=$HIL/mods/$1
  [ -e "$ko" ] && [ -z "$(find "$dir" -newer "$ko" \( -name '*.c' -o -name '*.h' -o -name Kbuild \) -print -quit)" ] && return
  make -s -C "$headers" M="$dir" modules >"$dir/log" 2>&1 || { cat "$dir/log" >&2; exit 1; }
  cp "$dir/$1.ko" "$ko"
}

# gpio-sim is in the kernel's sources and not in Debian's configuration; neither is the interrupt simulator it needs,
# which is carried inside the module (irq_to_desc() is not exported: its data gives the same descriptor).
if [ ! -e "$HIL/mods/gpio-sim/Kbuild" ]; then
  mkdir -p "$HIL/mods/gpio-sim" "$HIL/source"
  (cd "$HIL/deb" && rm -f linux-source-*.deb && apt-get download -qq linux-source-6.1)
  dpkg -x "$HIL"/deb/linux-source-*.deb "$HIL/source"
  tar -C "$HIL/source" --strip-components=1 -xf "$HIL"/source/usr/src/linux-source-6.1.tar.xz \
    linux-source-6.1/drivers/gpio linux-source-6.1/kernel/irq
  cp "$HIL/source/drivers/gpio/gpio-sim.c" "$HIL/mods/gpio-sim/gpio-sim-main.c"
  cp "$HIL/source/drivers/gpio/gpiolib.h" "$HIL/mods/gpio-sim/"
  sed 's/irq_to_desc(\([a-z]*\))/irq_data_to_desc(irq_get_irq_data(\1))/; /EXPORT_SYMBOL/d' \
    "$HIL/source/kernel/irq/irq_sim.c" >"$HIL/mods/gpio-sim/irq_sim.c"
  printf 'obj-m := gpio-sim.o\ngpio-sim-y := gpio-sim-main.o irq_sim.o\n' >"$HIL/mods/gpio-sim/Kbuild"
  rm -rf "$HIL/source" "$HIL"/deb/linux-source-*.deb
fi
module gpio-sim

# Modules of our own: tests/hil/mods/NAME.
for source in "$here"/mods/*/; do
  [ -d "$source" ] || continue
  name=$(basename "$source"); mkdir -p "$HIL/mods/$name"
  cp -u "$source"/* "$HIL/mods/$name/"
  module "$name"
done
