#!/usr/bin/env bash
# The USB cases through a real kernel: boots Debian's kernel in QEMU with the simulated device redirected into it. A few minutes; not part
# of `cargo test`. Needs Debian or Ubuntu: qemu-system-x86, busybox-static, cpio, kmod are installed where they are missing, and the
# package of the kernel is unpacked into a folder, not installed.
#
#   drivers/tests/usb/kernel.sh [CASE...]
set -euo pipefail
cd "$(dirname "$0")/../../.."

out=${ACIES_USB_KERNEL:-target/usb-kernel}
mkdir -p "$out"
out=$(cd "$out" && pwd)
if ! command -v qemu-system-x86_64 cpio depmod >/dev/null || [ ! -x /bin/busybox ]; then
  apt-get update -q && apt-get install -qy --no-install-recommends qemu-system-x86 busybox-static cpio kmod
fi
if [ ! -d "$out/kernel" ]; then
  package=$(apt-cache depends linux-image-amd64 | grep -oP 'linux-image-[0-9]\S+' | head -1)
  (cd "$out" && apt-get download "$package" && dpkg-deb -x "$package"*.deb kernel.new && rm -- "$package"*.deb)
  depmod -b "$out/kernel.new" "$(ls "$out/kernel.new/lib/modules")"
  mv "$out/kernel.new" "$out/kernel"
fi
version=$(ls "$out/kernel/lib/modules")
cp "$out/kernel/boot/vmlinuz-$version" "$out/vmlinuz"

program=$(cargo test -p acies-drivers --test usb --no-run --message-format=json \
  | grep -o '"executable":"[^"]*/usb-[^"]*"' | tail -1 | cut -d'"' -f4)

# A root file system of busybox, the host controller's modules, and the program with its libraries.
root=$(mktemp -d)
trap 'rm -rf "$root"' EXIT
mkdir -p "$root"/{bin,proc,sys,dev,tmp,lib64}
cp /bin/busybox "$root/bin/"
for tool in sh mount insmod stty poweroff; do ln -s busybox "$root/bin/$tool"; done
cp "$program" "$root/bin/usb"
for library in $(ldd "$program" | grep -oE '/[^ ]+\.so[^ ]*' | sort -u); do
  mkdir -p "$root$(dirname "$library")"
  cp -L "$library" "$root$library"
done
modules=()
for module in $(modprobe -d "$out/kernel" -S "$version" --show-depends xhci-pci | sed -n 's/^insmod //p'); do
  cp "$module" "$root/"
  modules+=("/$(basename "$module")")
done
cat >"$root/init" <<INIT
#!/bin/sh
mount -t proc proc /proc
mount -t sysfs sys /sys
mount -t devtmpfs dev /dev
for module in ${modules[*]}; do insmod \$module; done
stty raw -echo
echo READY
while read -r case variant; do
  CARGO_TARGET_TMPDIR=/tmp ACIES_USB_CASE="\$case \$variant" /bin/usb
  echo "DONE \$?"
done
poweroff -f
INIT
chmod +x "$root/init"
(cd "$root" && find . | cpio -o -H newc --quiet | gzip -1) >"$out/initrd"

ACIES_USB_KERNEL="$out" "$program" "$@"
