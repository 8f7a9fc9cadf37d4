#!/bin/bash
# Fifty scenes at four zooms as an array job of SLURM. Each of the eight tasks takes its part of the list; several run at a time.
#
#     sbatch examples/slurm_array.sh scenes.txt
#
# A task that is killed or runs out of time is queued again by SLURM, or by the same sbatch once more: what is finished is skipped, and what
# was half done continues from its state, which is saved every minute.
#SBATCH --job-name=mipmap-plugin
#SBATCH --array=1-8
#SBATCH --cpus-per-task=8
#SBATCH --mem=32G
#SBATCH --time=02:00:00
#SBATCH --requeue
#SBATCH --output=adapt_%A_%a.log

set -euo pipefail
export OMP_NUM_THREADS="${SLURM_CPUS_PER_TASK:-8}"

mipmap-plugin adapt --list "$1" \
    --scale 1/2 --scale 1/4 --scale 1/8 --scale 2 \
    --shard "${SLURM_ARRAY_TASK_ID:-1}/${SLURM_ARRAY_TASK_COUNT:-1}" \
    --jobs 2
