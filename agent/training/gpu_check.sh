#!/usr/bin/env bash
# Checks a machine with an NVIDIA GPU: builds with CUDA, compares the CPU kernels and the card with OpenVLA's
# packages, times a 7B checkpoint, and writes a report.
#
#   agent/training/gpu_check.sh --python PYTHON [--device cuda] [--size 7b] [--out runs/gpu-check] [--rever FILE]
#
# PYTHON has the packages of requirements-reference.lock and PyTorch. The 7B checkpoint takes 15 GB of disk,
# 17 GB of memory and 16 GB on the card. `--device cpu --size small` runs the same lines without a GPU.
# `--rever FILE` takes a program that is already built.
set -euo pipefail

python=python3 device=cuda size=7b out=runs/gpu-check rever=
usage() {
  echo "usage: $0 [--python FILE] [--device cpu|cuda|cuda:N] [--size small|real-towers|7b] [--out FOLDER] [--rever FILE]" >&2
  exit 2
}
while (($#)); do
  if (($# < 2)); then usage; fi
  case $1 in
    --python) python=$2 ;;
    --device) device=$2 ;;
    --size) size=$2 ;;
    --out) out=$2 ;;
    --rever) rever=$2 ;;
    *) usage ;;
  esac
  shift 2
done
mkdir -p "$out"
out=$(cd "$out" && pwd)
absolute() { echo "$(cd "$(dirname "$1")" && pwd)/$(basename "$1")"; }
if [[ $python == */* ]]; then python=$(absolute "$python"); fi
if [[ -n $rever ]]; then rever=$(absolute "$rever"); fi
cd "$(dirname "$0")/../.."
reference=agent/training/reference.py
features=()
if [[ $device != cpu ]]; then
  nvidia-smi --query-gpu=name,memory.total,driver_version --format=csv,noheader > "$out/gpu.txt"
  nvcc --version | tail -n 1 >> "$out/gpu.txt"
  features=(--features cli/cuda)
else
  echo "no GPU: the CPU part alone" > "$out/gpu.txt"
fi

echo "1. build"
if [[ -z $rever ]]; then
  cargo build --release --workspace --bin rever "${features[@]}"
  rever=target/release/rever
fi

status=0
# Compares one checkpoint with OpenVLA's packages on one device.
compare() {
  local folder=$1 on=$2 bound=$3
  shift 3
  "$python" "$reference" compare "$folder" --rever "$rever" --tolerance "$bound" \
    --json "$out/parity-$(basename "$folder")-${on/:/}.json" -- --device "$on" "$@" || status=1
}

echo "2. small checkpoints: CPU kernels and $device against OpenVLA's packages"
# Matrices of 16 bits on a GPU: logits within 5 % of their deviation, in 32 bits within 0.1 %.
bound=0.05
if [[ $device == cpu ]]; then bound=0.001; fi
for kind in openvla ecot v01; do
  folder=$out/small-$kind
  options=()
  if [[ $kind == openvla ]]; then options=(--unnorm-key bridge_orig); fi
  if [[ $kind == v01 ]]; then options=(--reasoning off); fi
  "$python" "$reference" build "$folder" --kind "$kind" --size small
  compare "$folder" cpu 0.001 "${options[@]}"
  if [[ $device != cpu ]]; then compare "$folder" "$device" "$bound" "${options[@]}"; fi
done

echo "3. openvla, size $size, on $device"
folder=$out/openvla-$size
if [[ ! -e $folder/complete ]]; then
  "$python" "$reference" build "$folder" --kind openvla --size "$size"
  touch "$folder/complete"
fi
compare "$folder" "$device" "$bound" --unnorm-key bridge_orig

echo "4. times"
if [[ $device != cpu ]]; then
  nvidia-smi --query-gpu=memory.used --format=csv,noheader,nounits --loop=1 > "$out/memory.txt" &
  sampler=$!
  trap 'kill "$sampler"' EXIT
fi
# One candidate, five and more share each token step; the table has N = 1, 2, 5, 8 and 16.
"$rever" bench decision --policy "$folder" --unnorm-key bridge_orig --device "$device" --rounds 2 \
  --observations "$folder/observations.safetensors" --json "$out/decision.json"
# Batches: concurrent episodes that decide together.
"$rever" bench throughput --policy "$folder" --unnorm-key bridge_orig --device "$device" --sessions 1,4,8 \
  --candidates 5 --decisions 32 --json "$out/throughput.json"
if [[ $device != cpu ]]; then
  echo "largest memory in use: $(sort -n "$out/memory.txt" | tail -n 1) MiB" >> "$out/gpu.txt"
fi

"$python" agent/training/gpu_report.py "$out"
exit "$status"
