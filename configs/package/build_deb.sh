#!/bin/sh
# Build the Debian package: build_deb.sh ARCHITECTURE [PYTHON [OUT]]
#   ARCHITECTURE  amd64 or arm64; PYTHON  the target's, default 3.11; OUT  default dist
# The package carries the wheels of everything it needs, in the versions of constraints.txt, so that
# its installation asks no network; on the target they are installed into an environment of their
# own, /opt/companion/venv. The target's Python with pip chooses the wheels: what is needed differs.
set -eu
arch=$1 python=${2:-3.11} out=${3:-dist}
here=$(cd "$(dirname "$0")" && pwd)
source=$(cd "$here/../.." && pwd)
case $arch in
    amd64) machine=x86_64 ;;
    arm64) machine=aarch64 ;;
    *) echo "build_deb.sh: architecture $arch: amd64 and arm64 are known" >&2; exit 2 ;;
esac
command -v "python$python" > /dev/null || { echo "build_deb.sh: needs python$python with pip" >&2; exit 2; }
command -v dpkg-deb > /dev/null || { echo "build_deb.sh: needs dpkg-deb (package dpkg)" >&2; exit 2; }
work=$(mktemp -d) && trap 'rm -rf "$work"' EXIT
root=$work/root
wheels=$root/opt/companion/wheels
mkdir -p "$wheels" "$root/DEBIAN" "$root/lib/systemd/system" "$root/lib/udev/rules.d" \
    "$root/etc/companion" "$root/usr/bin" "$root/usr/share/doc/pilot-companion" "$out"

export PIP_CONSTRAINT="$source/constraints.txt" PIP_BUILD_CONSTRAINT="$source/constraints.txt"
# Of a copy: setuptools leaves its build folder in the source otherwise.
(cd "$source" && git archive HEAD) | (mkdir "$work/source" && cd "$work/source" && tar x)
"python$python" -m pip wheel --quiet --no-deps --wheel-dir "$wheels" "$work/source"
version=$(basename "$wheels"/pilot_companion-*.whl | cut -d- -f2)
platforms=$(for tag in manylinux2014 manylinux_2_17 manylinux_2_27 manylinux_2_28; do
    printf -- '--platform %s_%s ' "$tag" "$machine"; done)
# shellcheck disable=SC2086  # the list is words
"python$python" -m pip download --quiet --only-binary=:all: $platforms --implementation cp \
    --python-version "$python" --dest "$wheels" \
    "pilot-companion[console] @ file://$(ls "$wheels"/pilot_companion-*.whl)" pip

cp "$source/configs/companion.service" "$root/lib/systemd/system/"
cp "$here/60-companion.rules" "$root/lib/udev/rules.d/"
cp "$source/LICENSE" "$root/usr/share/doc/pilot-companion/copyright"
cp "$source/README.md" "$source/CHANGELOG.md" "$root/usr/share/doc/pilot-companion/"
sed -e 's|^map: .*|map: /var/lib/companion/maps/area|' \
    -e 's|^  folder: .*|  folder: /var/lib/companion/flights/flight|' \
    "$source/configs/deployment.yaml" > "$root/etc/companion/deployment.yaml"
ln -s /opt/companion/venv/bin/companion "$root/usr/bin/companion"
for script in postinst prerm postrm; do
    install -m 755 "$here/debian/$script" "$root/DEBIAN/$script"
done
echo /etc/companion/deployment.yaml > "$root/DEBIAN/conffiles"
minor=${python#3.}
size=$(du -sk "$root" | cut -f1)
sed -e "s/@VERSION@/$version/" -e "s/@ARCH@/$arch/" -e "s/@SIZE@/$size/" \
    -e "s/@PYTHON@/3.$minor/" -e "s/@NEXT@/3.$((minor + 1))/" \
    "$here/debian/control.in" > "$root/DEBIAN/control"
find "$root" -type d -exec chmod 755 {} +
# The wheels are compressed already.
dpkg-deb --root-owner-group -Znone --build "$root" "$out/pilot-companion_${version}_${arch}.deb"
