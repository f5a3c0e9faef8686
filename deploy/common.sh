# Shared by deploy/demo and deploy/check: what a machine must have, installed or named. To be sourced from the root.

say() { printf '\033[1m== %s\033[0m\n' "$*" >&2; }
refuse() { printf 'modalcast: %s\n' "$*" >&2; exit 1; }
# Without -q, so that grep reads to the end: a pipe closed early would look like a failure under pipefail.
has_library() { /sbin/ldconfig -p 2>/dev/null | grep -F "$1" >/dev/null; }

# Debian packages by name: installed when we are root, else named.
need_packages() {
    local missing=()
    for package in "$@"; do
        dpkg-query -W -f '${Status}' "$package" 2>/dev/null | grep -q 'ok installed' || missing+=("$package")
    done
    [ ${#missing[@]} -eq 0 ] && return
    command -v apt-get >/dev/null || refuse "please install what your system calls: ${missing[*]}"
    [ "$(id -u)" -eq 0 ] || refuse "please install: sudo apt-get install ${missing[*]}"
    say "Installing ${missing[*]}"
    apt-get update -qq
    DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "${missing[@]}" >/dev/null
}

# The Rust toolchain is the user's own: a missing or old one is refused with the line that installs one.
need_rust() {
    local wanted found
    wanted=$(sed -n 's/^rust-version = "\(.*\)"/\1/p' Cargo.toml)
    local remedy="curl --proto '=https' --tlsv1.2 -sSf https://sh.rustup.rs | sh -s -- -y --default-toolchain stable"
    # A toolchain that was installed a minute ago is not on the PATH of an older shell.
    command -v cargo >/dev/null || PATH="$HOME/.cargo/bin:$PATH"
    command -v cargo >/dev/null && command -v rustc >/dev/null ||
        refuse "Rust $wanted or newer is needed and none was found. Install it with:
    $remedy"
    found=$(rustc --version | awk '{print $2}')
    [ "$(printf '%s\n%s\n' "$wanted" "$found" | sort -V | head -n 1)" = "$wanted" ] ||
        refuse "Rust $wanted or newer is needed, $found was found. Update it with: rustup update stable, or:
    $remedy"
    command -v cc >/dev/null || need_packages gcc libc6-dev
}

# OpenGL through EGL: NVIDIA's driver brings its own vendor library, Mesa's renders on the CPU.
need_egl() {
    has_library 'libEGL.so.1' || need_packages libegl1
    has_library 'libEGL_nvidia.so.0' && return 0
    has_library 'libEGL_mesa.so.0' || need_packages libegl-mesa0
    # Where Mesa keeps its drivers differs; Debian's package is asked for only where none is found.
    compgen -G '/usr/lib/*/dri/swrast_dri.so' >/dev/null || compgen -G '/usr/lib*/dri/swrast_dri.so' >/dev/null ||
        need_packages libgl1-mesa-dri
}

# NVRTC from the PyPI wheel, into an ignored folder that the server searches.
need_nvrtc() {
    compgen -G '.tools/nvrtc/nvidia/*/lib/libnvrtc.so.13' >/dev/null && return
    command -v python3 >/dev/null && python3 -m pip --version >/dev/null 2>&1 || need_packages python3 python3-pip
    say "Installing NVRTC (PyPI nvidia-cuda-nvrtc) into .tools/nvrtc"
    python3 -m pip install --quiet --disable-pip-version-check --no-deps --upgrade \
        --target .tools/nvrtc 'nvidia-cuda-nvrtc==13.0.88'
}

# A machine with an NVIDIA driver but without NVRTC gets the wheel; one without a driver needs neither.
need_nvrtc_for_driver() {
    has_library 'libcuda.so.1' || return 0
    has_library 'libnvrtc.so.13' && return 0
    need_nvrtc
}
