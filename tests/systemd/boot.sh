#!/bin/sh
# Process 1 of a small machine of its own: systemd over a copy-on-write view of this one's files. Nothing that happens there
# is seen outside: all namespaces are its own, what is written goes to memory, of this machine's units there are none.
#   boot.sh FOLDER SHARED CHECKOUT PYTHON_BASE SITE_PACKAGES
# FOLDER is where it is put together; the others are there as /opt/shared, /opt/checkout, /opt/base and /opt/packages.
# What is written on this machine shows in /opt/written.
set -eu
folder=$1 shared=$2 checkout=$3 python=$4 packages=$5
mount -t tmpfs tmpfs "$folder"
mkdir "$folder/upper" "$folder/work" "$folder/root"
root=$folder/root
mount -t overlay overlay -o "lowerdir=/,upperdir=$folder/upper,workdir=$folder/work" "$root"
# the interpreter, its packages and the checkout may lie where a service must not look
mkdir -p "$root/opt/base" "$root/opt/packages" "$root/opt/checkout" "$root/opt/shared" "$root/opt/written"
mount --bind "$folder/upper" "$root/opt/written"
mount --bind "$shared" "$root/opt/shared"
mount --bind "$python" "$root/opt/base"
mount --bind "$packages" "$root/opt/packages"
mount --bind "$checkout" "$root/opt/checkout"
for path in tmp run dev; do mount -t tmpfs tmpfs "$root/$path"; done
chmod 1777 "$root/tmp"
for device in null zero full random urandom tty; do
    : > "$root/dev/$device"
    mount --bind "/dev/$device" "$root/dev/$device"
done
mkdir "$root/dev/pts" "$root/dev/shm" "$root/run/old"
mount -t devpts -o newinstance,ptmxmode=0666,mode=620 devpts "$root/dev/pts"
ln -s pts/ptmx "$root/dev/ptmx"
mount -t tmpfs tmpfs "$root/dev/shm"
mount -t proc proc "$root/proc"
mount -t sysfs sysfs "$root/sys"
mount -t cgroup2 cgroup2 "$root/sys/fs/cgroup"
mount --bind "$root/proc/sys" "$root/proc/sys"
mount -o remount,bind,ro "$root/proc/sys"
cd "$root"
pivot_root . run/old
# its own units and those of the project, not this machine's
find /usr/lib/systemd/system /etc/systemd/system /usr/lib/tmpfiles.d /usr/lib/sysusers.d /etc/tmpfiles.d \
    -mindepth 1 -delete 2>/dev/null || true
for target in sysinit basic shutdown multi-user; do
    printf '[Unit]\nDefaultDependencies=no\n' > "/usr/lib/systemd/system/$target.target"
done
umount -l /run/old
exec env -i PATH=/usr/bin:/usr/sbin:/bin container=unshare \
    /usr/lib/systemd/systemd --unit=basic.target --log-target=console --log-level=warning
