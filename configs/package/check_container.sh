#!/bin/sh
# Start what the Containerfile built, with no vehicle, no camera and no deployment:
#   check_container.sh IMAGE [REPORT.json]
# Needs buildah (BUILDAH="buildah --root FOLDER": another store). For another architecture than this
# one's: qemu-user with binfmt, and root. qemu-user shows the host's /proc/cpuinfo, in which ONNX
# Runtime looks for ARM's lines, and ends with a segmentation fault where there are none; so
# CPUINFO=FILE, as an ARM board's says it, is bound over it while the program runs.
# PILOT_SELF_TEST=later: no self-test, where emulation would take half an hour over it.
set -eu
image=$1 report=${2:-/dev/null}
buildah=${BUILDAH:-buildah}
if [ -n "${CPUINFO:-}" ] && [ -z "${CPUINFO_BOUND:-}" ]; then
    export CPUINFO_BOUND=1
    exec unshare --mount --propagation private sh -c \
        'mount --bind "$CPUINFO" /proc/cpuinfo && exec "$0" "$@"' "$0" "$@"
fi
say() { echo "== $*"; }
fail() { echo "check_container.sh: $*" >&2; exit 1; }
arch=$($buildah inspect --type image --format '{{.OCIv1.Architecture}}' "$image")
user=$($buildah inspect --type image --format '{{.OCIv1.Config.User}}' "$image")
[ "$user" = 990:990 ] || fail "the program would run as user $user"
out=$(mktemp -d)
container=$($buildah from --pull-never --arch "$arch" "$image")
trap '$buildah rm "$container" > /dev/null; rm -rf "$out"' EXIT
# sh tells the exit code, which buildah does not pass on in every isolation.
inside() { $buildah run ${QEMU_CPU:+--env QEMU_CPU=$QEMU_CPU} "$container" -- \
    sh -c "$1; echo \"exit \$?\"" > "$out/said" 2>&1 || { cat "$out/said"; fail "$1: did not end"; }; cat "$out/said"; }
ended() { grep -qx "exit $1" "$out/said" || fail "$2: not the exit code $1"; }

say "companion --version ($arch)"
inside "companion --version"
ended 0 "companion --version"
version=$(grep -m1 -E '^companion [0-9]' "$out/said") || fail "no version"
say "no deployment"
inside "companion run --supervised /etc/companion/deployment.yaml"
ended 2 "without a deployment"
grep -q "/etc/companion/deployment.yaml" "$out/said" || fail "the missing deployment is not named"
say "doctor, no map"
inside "companion init --reference > own.yaml && companion doctor --no-vehicle own.yaml"
ended 2 "the doctor without a map"
tested="left out"
if [ "${PILOT_SELF_TEST:-now}" = now ]; then
    say "self-test"
    inside "companion self-test"
    ended 0 "self-test"
    tested=$(sed -n 's/^self-test passed: \(.*\), [0-9]* ms.*/passed: \1/p' "$out/said")
    [ -n "$tested" ] || fail "the self-test does not say how near it came"
fi
printf '{"columns": ["container", "`--version`", "`run` without a deployment", "`doctor` without a map", "self-test"],\n "rows": [["%s", "%s", "ends with 2, names it", "ends with 2, names it", "%s"]]}\n' \
    "$arch" "$version" "$tested" > "$report"
say "passed: $image ($arch)"
