#!/bin/sh
# What `make install` and the Debian package put beside the program: units, users, rules, completions, man pages.
#   install.sh ROOT PREFIX PYTHON LIBRARY
# ROOT is put before every path that is written, and into none; PYTHON and LIBRARY (where it imports from) are what the two
# commands run with. BUILD_PYTHON and BUILD_LIBRARY, by default the same, make completions and man pages.
set -eu
root=$1 prefix=$2 python=$3 library=$4
build_python=${BUILD_PYTHON:-$python} build_library=${BUILD_LIBRARY:-$library}
# a path may have spaces; anything else is a command with its arguments
[ ! -x "$python" ] || python="'$python'"
here=$(cd "$(dirname "$0")" && pwd)
checkout=$(dirname "$here")
lib=$root$prefix/lib share=$root$prefix/share

put() { install -D -m 644 "$1" "$2"; }

for program in tormagd.daemon:tormagd tormagd.ctl:tormagctl tormag_lab:tormag-lab; do
    install -d "$root$prefix/bin"
    # children, such as a replay, find the library by the same variable
    cat > "$root$prefix/bin/${program#*:}" <<END
#!/bin/sh
PYTHONPATH='$library' exec $python -P -s -m ${program%:*} "\$@"
END
    chmod 755 "$root$prefix/bin/${program#*:}"
done

# one text for one console and for several: an instance has its own configuration, sockets and state
units=$lib/systemd/system
install -d "$units"
put "$here/tormag.target" "$units/tormag.target"
for unit in tormagd tormag-record; do
    sed "s|/usr/bin/|$prefix/bin/|; s|/usr/share/|$prefix/share/|" "$here/$unit.service" > "$units/$unit.service"
    sed "s|^Description=.*|& (%i)|; s|/etc/tormag/tormagd.toml|/etc/tormag/%i.toml|
         s|^RuntimeDirectory=tormag$|&-%i|; s|^StateDirectory=tormag|&/%i|; s|/var/lib/tormag/|&%i/|
         s|tormagd\.service|tormagd@%i.service|" "$units/$unit.service" > "$units/$unit@.service"
    chmod 644 "$units/$unit.service" "$units/$unit@.service"
done
put "$here/sysusers.d/tormag.conf" "$lib/sysusers.d/tormag.conf"
put "$here/tmpfiles.d/tormag.conf" "$lib/tmpfiles.d/tormag.conf"
put "$here/modules-load.d/tormag.conf" "$lib/modules-load.d/tormag.conf"
put "$here/udev/60-tormag.rules" "$lib/udev/rules.d/60-tormag.rules"
for drop_in in "$here"/drop-ins/*.conf; do put "$drop_in" "$share/tormagd/drop-ins/$(basename "$drop_in")"; done
for text in "$checkout/README.md" "$checkout/CHANGELOG.md" "$here/README.md"; do
    name=$(basename "$text")
    [ "$text" = "$here/README.md" ] && name=service.md
    put "$text" "$share/doc/tormagd/$name"
done
# the guides name them, and one of them begins without a device
for example in $(cd "$checkout/examples" && find . -type f ! -path '*/__pycache__/*'); do
    put "$checkout/examples/$example" "$share/doc/tormagd/examples/$example"
done
# an installed configuration is its owner's, and stays as it is
[ -e "$root/etc/tormag/tormagd.toml" ] || put "$checkout/examples/service.toml" "$root/etc/tormag/tormagd.toml"

install -d "$share/bash-completion/completions" "$share/zsh/site-functions" "$share/man/man1"
PYTHONPATH=$build_library "$build_python" -P "$here/pages.py" "$share"
