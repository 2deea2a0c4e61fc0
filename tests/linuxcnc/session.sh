#!/bin/sh
# Runs a command for LinuxCNC in the folder it is called in.
#   session.sh private MODULES COMMAND...   as root, in namespaces of its own: nothing is left behind, nothing is installed
#   session.sh shared  MODULES COMMAND...   as root, where namespaces are not allowed: installs the modules for the time being
#   session.sh plain   MODULES COMMAND...   as an ordinary user, with the modules that are installed
# MODULES is a folder with built modules (it may be empty). As root the command runs as the user "nobody".
set -u
mode=$1 modules=$2 system=/usr/lib/linuxcnc/modules here=$(pwd)
shift 2
as_user() {
    if [ "$(id -u)" = 0 ]; then
        runuser -u nobody -- env -i HOME="$here" PATH=/usr/bin:/bin LANG=C "$@" </dev/null
    else
        env -i HOME="$here" PATH=/usr/bin:/bin LANG=C "$@" </dev/null
    fi
}
case $mode in
private)
    mkdir -p "$here/tmp" "$here/modules" "$here/system" && chmod 1777 "$here/tmp" || exit 3
    mount --bind "$system" "$here/system" || exit 3
    mount -t tmpfs tmpfs "$here/modules" && chmod 755 "$here/modules" || exit 3
    cp -s "$here/system"/*.so "$here/modules" || exit 3
    for file in "$modules"/*.so; do [ -e "$file" ] && cp --remove-destination "$file" "$here/modules"; done
    mount --bind "$here/modules" "$system" && mount --bind "$here/tmp" /tmp || exit 3
    ip link set lo up 2>/dev/null
    as_user "$@"
    ;;
shared)
    added=
    for file in "$modules"/*.so; do
        [ -e "$file" ] || continue
        target=$system/$(basename "$file")
        [ -e "$target" ] && { echo "$target is there already" >&2; exit 4; }
        added="$added $target"
        cp "$file" "$target"
    done
    trap 'rm -f $added' EXIT
    trap 'exit 143' TERM INT HUP
    as_user "$@"
    ;;
*)
    as_user "$@"
    ;;
esac
