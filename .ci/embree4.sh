#!/bin/sh
# Runs the accelerators' tests and two renders on Debian 13's Embree 4 on a Debian 12 machine, without root and without
# changing the system: the packages are fetched by apt (its sources are this machine's own, with the suite replaced),
# unpacked, and all runs under Debian 13's dynamic loader. Takes 13 MB of downloads and 60 MB of disk.
#
#   .ci/embree4.sh [directory]        default: target/embree4; exit code 3 where the packages can't be had
set -eu
root=$(cd "$(dirname "$0")/.." && pwd)
dir=${1:-$root/target/embree4}
[ "$(uname -m)" = x86_64 ] || { echo "only on x86-64" >&2; exit 3; }
mkdir -p "$dir/apt/lists/partial" "$dir/apt/cache/archives/partial" "$dir/debs" "$dir/prefix"
cd "$dir"
dir=$(pwd)

# One-line or deb822 sources of the Debian main archive, bookworm become trixie.
: >apt/trixie.sources
for file in /etc/apt/sources.list.d/*.sources; do
    [ -f "$file" ] && grep -q 'Suites:.*bookworm' "$file" && { cat "$file"; echo; } >>apt/trixie.sources
done
sed -i 's/bookworm/trixie/g' apt/trixie.sources
grep -h '^deb .*bookworm' /etc/apt/sources.list 2>/dev/null | sed 's/bookworm/trixie/g' >apt/trixie.list || true
[ -s apt/trixie.sources ] || [ -s apt/trixie.list ] || { echo "no Debian source found in /etc/apt" >&2; exit 3; }
mkdir -p apt/parts && mv apt/trixie.sources apt/trixie.list apt/parts/ 2>/dev/null || true

cat >apt/apt.conf <<CONF
Dir::Etc::sourcelist "/dev/null";
Dir::Etc::sourceparts "$dir/apt/parts";
Dir::State::lists "$dir/apt/lists";
Dir::State::status "/var/lib/dpkg/status";
Dir::Cache "$dir/apt/cache";
APT::Sandbox::User "$(id -un)";
CONF
apt-get -c apt/apt.conf -qq update || exit 3
(cd debs && apt-get -c ../apt/apt.conf -qq download libembree-dev/trixie libembree4-4/trixie libtbb12/trixie \
    libtbbmalloc2/trixie libtbbbind-2-5/trixie libhwloc15/trixie libc6/trixie libstdc++6/trixie libgcc-s1/trixie) || exit 3
for deb in debs/*.deb; do dpkg -x "$deb" prefix; done

lib=$dir/prefix/usr/lib/x86_64-linux-gnu
# lib → usr/lib in Debian 13; what links to an absolute path is linked anew.
loader=$(find "$dir/prefix" -name 'ld-linux-x86-64.so.2' | head -n 1)
cd "$root"
export EMBREE_DIR=$dir/prefix/usr
export CARGO_TARGET_X86_64_UNKNOWN_LINUX_GNU_RUNNER="$loader --library-path $lib:$dir/prefix/lib/x86_64-linux-gnu"
target=${CARGO_TARGET_DIR:-target}

# No test may be lost behind a filter that no longer names one.
cargo test --target-dir "$target" --test rendering accelerators:: | tee "$dir/tests.txt"
passed=$(sed -n 's/^test result: ok\. \([0-9]*\) passed.*/\1/p' "$dir/tests.txt")
[ "${passed:-0}" -ge 10 ] || { echo "the accelerators' tests did not all pass" >&2; exit 1; }

# A render from end to end, opaque, instanced and alpha-tested, against the same on `bvh`.
for scene in colonnade materials; do
    for accel in embree bvh; do
        cargo run -q --target-dir "$target" -- render "scenes/$scene.glb" --dome scenes/studio.exr --size 96x64 --spp 4 \
            --sampler tessellated:cache=off --accel "$accel" -o "$dir/$scene-$accel.exr" -q
    done
    cargo run -q --target-dir "$target" -- compare "$dir/$scene-embree.exr" "$dir/$scene-bvh.exr" --max-relmse 1e-4
done
echo "Embree 4: $passed tests, two renders"
