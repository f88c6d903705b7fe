#!/bin/sh
# Install, start, upgrade, remove and purge the package in a clean Debian root:
#   check_deb.sh DEB [SUITE [REPORT.json]]
# Needs root and mmdebstrap, and qemu-user with binfmt for another architecture than this one's:
# there the upgrade leaves the self-test for later, since the installation has just passed it.
# PILOT_SELF_TEST=later: none at all, where emulation would take half an hour over it.
# What it cannot show in a root without a running systemd: the unit's own restrictions, which
# as_service.py applies.
set -eu
deb=$(realpath "$1") suite=${2:-bookworm} report=${3:-/dev/null}
arch=$(dpkg-deb --field "$deb" Architecture)
root=${ROOT:-$(mktemp -d)/root}
self_test=${PILOT_SELF_TEST:-now}
step=root began=$(date +%s) seconds=
say() { echo "== $*"; }
begin() {
    now=$(date +%s)
    seconds="$seconds${seconds:+, }\"$step\": $((now - began))"
    step=$1 began=$now
    say "$1"
}
# QEMU_CPU: float32 products are NaN under qemu's default processor; cortex-a72 computes rightly.
in_root() { chroot "$root" env -i ${QEMU_CPU:+QEMU_CPU=$QEMU_CPU} PILOT_SELF_TEST=$self_test PATH=/usr/sbin:/usr/bin:/sbin:/bin HOME=/root LC_ALL=C.UTF-8 \
    DEBIAN_FRONTEND=noninteractive "$@"; }
as_service() { in_root setpriv --reuid companion --regid companion --init-groups \
    --no-new-privs --bounding-set=-all --inh-caps=-all env HOME=/var/lib/companion \
    NUMBA_CACHE_DIR=/var/cache/companion/kernels PILOT_CACHE=/var/cache/companion "$@"; }
fail() { echo "check_deb.sh: $*" >&2; exit 1; }

if [ ! -x "$root/usr/bin/dpkg" ]; then
    say "a clean $suite root for $arch in $root"
    mmdebstrap --quiet --arch="$arch" --variant=apt "$suite" "$root"
fi
mountpoint -q "$root/proc" || mount -t proc proc "$root/proc"
mountpoint -q "$root/dev" || mount --rbind --make-rslave /dev "$root/dev"
trap 'umount -l "$root/proc" "$root/dev"' EXIT

begin install
cp /etc/resolv.conf "$root/etc/resolv.conf"
in_root apt-get -q update
cp "$deb" "$root/tmp/new.deb"
in_root apt-get -q -y install --no-install-recommends /tmp/new.deb
in_root companion --version
[ "$(in_root stat -c %U:%G:%a /etc/companion/deployment.yaml)" = root:companion:640 ] \
    || fail "the deployment file can be read by others"
as_service sh -c 'echo > /opt/companion/x' 2> /dev/null && fail "the service may write its program"

begin start
# As the unit does, over a map, with no vehicle and no camera.
tested=null
if [ "$self_test" = now ]; then
    as_service sh -c 'cd /var/lib/companion && companion self-test --out self-test.json'
    tested=$(cat "$root/var/lib/companion/self-test.json")
fi
# A failure by name where there is no map yet, as on a fresh computer.
code=0; as_service companion run /etc/companion/deployment.yaml || code=$?
[ "$code" = 2 ] || fail "without a map the exit code is $code, not 2"

begin upgrade
dpkg-deb -R "$root/tmp/new.deb" "$root/tmp/next"
sed -i 's/^Version: .*/&+next/' "$root/tmp/next/DEBIAN/control"
dpkg-deb --root-owner-group -Znone --build "$root/tmp/next" "$root/tmp/next.deb" > /dev/null
rm -rf "$root/tmp/next"
echo "# mine" >> "$root/etc/companion/deployment.yaml"
echo keep > "$root/var/lib/companion/flights/mine"
[ "$arch" = "$(dpkg --print-architecture)" ] || self_test=later
in_root dpkg --force-confold -i /tmp/next.deb
in_root companion --version
grep -q "^# mine" "$root/etc/companion/deployment.yaml" || fail "the upgrade replaced the deployment"
[ -f "$root/var/lib/companion/flights/mine" ] || fail "the upgrade took a record"

begin remove
in_root dpkg --remove pilot-companion
[ ! -e "$root/opt/companion/venv" ] || fail "the program is still there"
[ -f "$root/var/lib/companion/flights/mine" ] || fail "removing took a record"
begin purge
in_root dpkg --purge pilot-companion
for left in /opt/companion /var/lib/companion /var/cache/companion /etc/companion; do
    [ ! -e "$root$left" ] || fail "$left is still there"
done
in_root getent passwd companion > /dev/null && fail "the user is still there"
rm "$root/tmp/new.deb" "$root/tmp/next.deb"
begin passed
printf '{"package": "%s", "suite": "%s", "upgrade_tested": %s, "seconds": {%s}, "self_test": %s}\n' \
    "$(basename "$deb")" "$suite" "$([ "$self_test" = now ] && echo true || echo false)" "$seconds" \
    "$tested" > "$report"
say "passed: $(basename "$deb")"
