#!/bin/sh
# Packs a Debian package:  deb.sh LIBRARY OUT
# LIBRARY is a folder with the three distributions and what bundled.txt lists, for PYTHON (/usr/bin/python3), which the package runs
# with. What else they import is Debian's: Depends is for the service, Recommends for what is drawn, served and fitted. torch is
# nobody's here: it is for networks' training and two searches only. DEBFULLNAME and DEBEMAIL name who builds.
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

build_python=${BUILD_PYTHON:-$python}
BUILD_PYTHON=$build_python BUILD_LIBRARY=${BUILD_LIBRARY:-$checkout:$checkout/client/src} \
    "$here/install.sh" "$root" /usr "${RUN_PYTHON:-$python}" /usr/lib/tormagd
inside=$root/usr/lib/tormagd doc=$root/usr/share/doc/tormagd
cp -a "$library/." "$inside"
find "$inside" \( -name __pycache__ -o -name tests -o -name INSTALLER -o -name REQUESTED -o -name RECORD \) -prune -exec rm -rf {} +
find "$inside" -path '*.dist-info/licenses' -prune -exec rm -rf {} +    # they are in copyright
find "$inside" -type f -name '*.so' -exec strip --strip-unneeded {} + -exec chmod 644 {} +
"$build_python" -P "$here/sbom.py" "$inside" "$inside/tormagd/view/page" > "$doc/sbom.cdx.json"
cp "$here/copyright" "$doc/copyright"
install -D -m 644 "$here/lintian-overrides" "$root/usr/share/lintian/overrides/tormagd"
maintainer="${DEBFULLNAME:-The tormagd developers} <${DEBEMAIL:-maintainers@tormagd.invalid}>"
# packages of one state of the sources are equal
export SOURCE_DATE_EPOCH="${SOURCE_DATE_EPOCH:-$(git -C "$checkout" log -1 --format=%ct 2>/dev/null || date -r "$checkout/CHANGELOG.md" +%s)}"
gzip -9n > "$doc/changelog.gz" <<END
tormagd ($version) unstable; urgency=medium

  * CHANGELOG.md beside this file says what users notice.

 -- $maintainer  $(date -uR -d "@$SOURCE_DATE_EPOCH")
END
packages() { printf 'python3-%s, ' "$@" | sed 's/, $//'; }
mkdir "$root/DEBIAN"
echo /etc/tormag/tormagd.toml > "$root/DEBIAN/conffiles"
cat > "$root/DEBIAN/control" <<END
Package: tormagd
Version: $version
Architecture: $(dpkg --print-architecture)
Maintainer: $maintainer
Installed-Size: $(du -sk "$root" | cut -f1)
Depends: libc6, libgcc-s1, python3 (>= $abi), python3 (<< $next), systemd, passwd, procps, $(packages lz4 msgpack numpy packaging serial typing-extensions uvloop wrapt zmq zstandard)
Recommends: $(packages aiohttp matplotlib prometheus-client rich scipy tqdm)
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
py3compile -p tormagd /usr/lib/tormagd
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
py3clean -p tormagd
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
