#!/usr/bin/env bash
# Half an hour of a GPU machine, in commands of at most ten minutes each that leave their results in $OUT, in files that
# are small enough to be carried anywhere. Run them in this order, each with the folders that it names:
#
#   SPEECH=DIR DATA=DIR           bash export/gpu_plan.sh simulate   items of speech that is in part, on all cores
#   DATA=DIR OUT=DIR              bash export/gpu_plan.sh large      four times the edge network's weights
#   DATA=DIR OUT=DIR              bash export/gpu_plan.sh edge       the network that runs within a hop
#   DATA=DIR OUT=DIR              bash export/gpu_plan.sh paper      the paper's network, 34 M weights
#   DATA=DIR OUT=DIR              bash export/gpu_plan.sh all        all four: a rehearsal, with QUICK=1 on any processor
#
# SPEECH holds human/train*, human/val, robot/train, robot/val, and if there are any noise and rir (docs/train.md); it may
# come in parts: `simulate` again with another part makes further items. DATA is made. MINUTES: of each training. QUICK=1:
# seconds of data, four steps of tiny networks, to see that every command runs. START: weights that `edge` goes on from.
set -euo pipefail

MINUTES=${MINUTES:-8.5} SIMULATE_MINUTES=${SIMULATE_MINUTES:-6} SEED=${SEED:-1} CORES=$(nproc)
PYTHON=${PYTHON:-python3} PART_BYTES=15000000
export OMP_NUM_THREADS=1

many=(--count 20000 --minutes "$SIMULATE_MINUTES") few=(--count 96)
large=(--channels 24 40 64 64 --hidden 512 --batch 64) edge=(--batch 64) paper=(--batch 16 --seconds 4 --long-every 0)
if [ -n "${QUICK:-}" ]; then
    many=(--count 3 --rooms 3) few=(--count 2 --rooms 3) CORES=1 MINUTES=0.1
    large=(--channels 4 4 4 4 --hidden 8 --batch 2 --steps 4 --every 4) edge=("${large[@]}")
    paper=(--steps 1 --every 1 --batch 1 --seconds 0.5)
fi

simulate() { # every part of the speech has items of its own
    local more=() humans
    [ -d "$SPEECH/noise" ] && more+=(--noise "$SPEECH/noise")
    [ -d "$SPEECH/rir" ] && more+=(--responses "$SPEECH/rir")
    humans=("$SPEECH"/human/train*)
    "$PYTHON" -m export.dataset --humans "$SPEECH/human/val" --robots "$SPEECH/robot/val" "${more[@]}" --recipe wide \
        --output "$DATA/validation" --seed 102 --jobs "$CORES" "${few[@]}"
    "$PYTHON" -m export.dataset --humans "${humans[@]}" --robots "$SPEECH/robot/train" "${more[@]}" --recipe wide \
        --output "$DATA/train" --seed "$SEED" --jobs "$CORES" "${many[@]}"
}

learn() { # name, options of export.train
    local name=$1
    shift
    "$PYTHON" -m export.train --data "$DATA/train" --validation "$DATA/validation" --output "$DATA/run_$name" \
        --steps 200000 --every 500 --minutes "$MINUTES" --seed "$SEED" "$@"
    mkdir -p "$OUT"
    cp "$DATA/run_$name/log.jsonl" "$OUT/$name.jsonl"
}

weights() { # name
    "$PYTHON" -m export.checkpoint "$DATA/run_$1/last.pt" --output "$OUT/$1.pt"
}

case "${1:-}" in
simulate) simulate ;;
large) learn large "${large[@]}" && weights large ;;
edge) learn edge "${edge[@]}" ${START:+--start "$START"} && weights edge ;;
paper) # 34 M weights: as int8 for the runtime, cut to parts (put together: cat paper_int8.onnx.* > paper_int8.onnx)
    learn paper --network paper "${paper[@]}"
    "$PYTHON" -m export.onnx_export "$DATA/run_paper/best.pt" --output "$DATA/paper.onnx" --int8
    split -b "$PART_BYTES" "$DATA/paper_int8.onnx" "$OUT/paper_int8.onnx."
    ;;
all) for step in simulate large edge paper; do bash "$0" "$step"; done ;;
*)
    sed -n '2,17s/^# \{0,1\}//p' "$0"
    exit 2
    ;;
esac
