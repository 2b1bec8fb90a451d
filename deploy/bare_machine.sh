#!/bin/sh
# Runs make targets on bare machines: a fresh Debian or Ubuntu with apt, make and python3 alone, in a folder, entered by
# chroot.
#   deploy/bare_machine.sh SUITE [TARGET...]     SUITE: bookworm, trixie, noble ...; TARGET: of the Makefile, default demo and test
# Needs root and mmdebstrap. It runs the committed tree. Its mounts are not visible outside, and all its processes end
# with it.
#   BARE_FOLDER     folder of the machine, 10 GB; default /var/tmp/dentine-bare. Logs and times stay there, the machine does not
#   BARE_USER       yes: targets are run by an ordinary user who may call sudo; default: by root
#   BARE_KEEP       yes: the machine stays in its folder
#   BARE_MIRROR     mirror of the packages; default: Debian's own, or Ubuntu's for its suites
#   BARE_KEYRING    file with the keys of the mirror; default: the one that apt has
#   BARE_MOUNTS     "FILE[:INSIDE] ..." of this machine's apt and pip configuration, mounted there and never copied; /etc/resolv.conf always is
#   BARE_VARIABLES  names of environment variables that targets are given, such as PIP_CERT
set -eu

say() { printf 'bare machine: %s\n' "$*" >&2; }
die() { say "$1"; exit "${2:-2}"; }

# Inside a mount namespace of its own: fill the machine's folders and run the targets there.
inside() {
    machine=$1 suite=$2 who=$3
    shift 3
    mount --rbind /dev "$machine/dev"
    mount --rbind /sys "$machine/sys"
    mount -t proc proc "$machine/proc"
    mount -t tmpfs tmpfs "$machine/run"
    for pair in /etc/resolv.conf ${BARE_MOUNTS:-}; do
        seen=$machine${pair#*:}
        if [ -d "${pair%%:*}" ]; then mkdir -p "$seen"; else mkdir -p "${seen%/*}"; [ -e "$seen" ] || : >"$seen"; fi
        mount --bind "${pair%%:*}" "$seen"
    done
    home=/root
    [ "$who" = root ] || home=/home/$who
    targets=$*
    set -- PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin HOME="$home"
    for name in ${BARE_VARIABLES:-}; do
        eval "value=\${$name:-}"
        [ -z "$value" ] || set -- "$@" "$name=$value"
    done
    status=0
    for target in $targets; do
        log=$logs/$suite-$who-$target.log began=$(date +%s) ended=passed
        chroot --userspec="$who:$who" "$machine" env -i "$@" make -C "$home/dentine" "$target" </dev/null >"$log" 2>&1 || ended=failed status=1
        printf '%s %s make %s: %s in %s s\n' "$suite" "$who" "$target" "$ended" "$(($(date +%s) - began))" | tee -a "$logs/times"
        [ "$ended" = passed ] || tail -n 25 "$log" >&2
    done
    return $status
}

make_machine() {
    case "$suite" in
        jammy | noble | oracular | plucky | questing) mirror=http://archive.ubuntu.com/ubuntu parts=main,universe ;;
        *) mirror=http://deb.debian.org/debian parts=main ;;
    esac
    packages=make,python3
    [ "$who" = root ] || packages=$packages,passwd,sudo
    say "making $suite"
    mmdebstrap --quiet --variant=apt --include="$packages" --components="$parts" ${BARE_KEYRING:+--keyring="$BARE_KEYRING"} \
        "$suite" "$machine" "${BARE_MIRROR:-$mirror}" </dev/null >"$logs/$suite-machine.log" 2>&1 || die "mmdebstrap failed; see $logs/$suite-machine.log." 1
    # An installation writes this file, and the packages alone do not.
    echo "127.0.0.1 localhost" >"$machine/etc/hosts"
    home=$machine/root
    if [ "$who" != root ]; then
        chroot "$machine" useradd --create-home "$who"
        echo "$who ALL=(ALL) NOPASSWD: ALL" >"$machine/etc/sudoers.d/$who"
        home=$machine/home/$who
    fi
    mkdir "$home/dentine"
    git -C "$(dirname "$0")/.." archive HEAD | tar -x -C "$home/dentine"
    chroot "$machine" chown -R "$who:$who" "${home#"$machine"}/dentine"
}

if [ "${1:-}" = --inside ]; then
    logs=$2
    shift 2
    inside "$@"
    exit
fi

[ $# -ge 1 ] || die "name the suite, such as bookworm; the head of $0 tells the rest."
[ "$(id -u)" -eq 0 ] || die "only root may make a machine; run it as root."
command -v mmdebstrap >/dev/null || die "mmdebstrap is missing; install it."
suite=$1
shift
[ $# -gt 0 ] || set -- demo test
who=root
[ -z "${BARE_USER:-}" ] || who=stranger
folder=${BARE_FOLDER:-/var/tmp/dentine-bare}
logs=$folder/logs machine=$folder/$suite-$who
mkdir -p "$logs"
[ ! -e "$machine" ] || die "$machine is there already; remove it or set BARE_FOLDER."
[ -n "${BARE_KEEP:-}" ] || trap 'rm -rf --one-file-system "$machine"' EXIT
trap 'exit 130' INT TERM
make_machine
unshare --mount --pid --fork --kill-child "$0" --inside "$logs" "$machine" "$suite" "$who" "$@"
