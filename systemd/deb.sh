#!/bin/sh
# Packs a Debian package:  deb.sh LIBRARY OUT
# LIBRARY is a folder with the three distributions and all that they import, for PYTHON (/usr/bin/python3), which the package runs with. All
# of it is in the package, but for torch, which only networks' training and two searches need: a console need not reach a registry.
set -eu
library=$1 out=$2
python=${PYTHON:-/usr/bin/python3}
here=$(cd "$(dirname "$0")" && pwd)
checkout=$(dirname "$here")
version=$(sed -n 's/^__version__ = "\(.*\)"/\1/p' "$checkout/client/src/tormagd_client/__init__.py")
abi=$("$python" -c 'import sys; print(*sys.version_info[:2], sep=".")')
next=${abi%.*}.$((${abi#*.} + 1))
root=$(mktemp -d)
trap 'rm -rf "$root"' EXIT
chmod 755 "$root"

BUILD_PYTHON=${BUILD_PYTHON:-$python} BUILD_LIBRARY=${BUILD_LIBRARY:-$checkout:$checkout/client/src} \
    "$here/install.sh" "$root" /usr "${RUN_PYTHON:-$python}" /usr/lib/tormagd
cp -a "$library/." "$root/usr/lib/tormagd"
mkdir "$root/DEBIAN"
echo /etc/tormag/tormagd.toml > "$root/DEBIAN/conffiles"
cat > "$root/DEBIAN/control" <<END
Package: tormagd
Version: $version
Architecture: $(dpkg --print-architecture)
Maintainer: The tormagd developers <tormagd@localhost>
Installed-Size: $(du -sk "$root" | cut -f1)
Depends: python3 (>= $abi), python3 (<< $next), systemd, passwd
Section: science
Priority: optional
Description: Real-time haptic controller daemon
 Controls a friction brake with a magnetorheological elastomer: takes force
 setpoints over ZeroMQ, and drives the device over a serial line or CAN.
END
cat > "$root/DEBIAN/postinst" <<'END'
#!/bin/sh
set -e
[ "$1" = configure ] || exit 0
systemd-sysusers tormag.conf
systemd-tmpfiles --create tormag.conf
if [ -d /run/systemd/system ]; then
    systemctl daemon-reload
    udevadm control --reload 2>/dev/null || true
    # a brake that holds a catheter is not let go of for an upgrade
    systemctl is-active --quiet 'tormagd*' && echo "tormagd goes on as it is: systemctl restart tormagd when the brake is free"
fi
exit 0
END
cat > "$root/DEBIAN/prerm" <<'END'
#!/bin/sh
set -e
if [ "$1" = remove ] && [ -d /run/systemd/system ]; then
    systemctl stop 'tormag-record*.service' 'tormagd*.service' tormag.target || true
    # a template's name stands for all its instances
    systemctl disable --quiet tormag.target tormagd.service tormagd@.service tormag-record.service tormag-record@.service \
        2>/dev/null || true
fi
find /usr/lib/tormagd -name __pycache__ -prune -exec rm -rf {} +
END
cat > "$root/DEBIAN/postrm" <<'END'
#!/bin/sh
set -e
[ ! -d /run/systemd/system ] || systemctl daemon-reload
# a running daemon has its files in it: without them it is dead to the watchdog
[ "$1" = upgrade ] || rm -rf /run/tormag.root
if [ "$1" = purge ]; then
    # keys, profiles and recordings, too
    rm -rf /var/lib/tormag /etc/tormag
    ! getent passwd tormag > /dev/null || userdel tormag
    ! getent group tormag > /dev/null || groupdel tormag
fi
END
chmod 755 "$root/DEBIAN/postinst" "$root/DEBIAN/prerm" "$root/DEBIAN/postrm"
mkdir -p "$out"
dpkg-deb --root-owner-group "-Z${COMPRESSION:-xz}" --build "$root" "$out/tormagd_${version}_$(dpkg --print-architecture).deb"
