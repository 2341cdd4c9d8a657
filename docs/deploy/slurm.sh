#!/bin/bash
# cosfly on SLURM, in one of two ways (docs/scaling.md):
#   sbatch --nodes=4 docs/deploy/slurm.sh CONFIG OUT                  one run on a Ray cluster of the job's nodes
#   sbatch --nodes=1 --array=0-2 docs/deploy/slurm.sh CONFIG OUT grid park river    a town a task, for each town of CONFIG; then the release:
#   sbatch --nodes=1 --dependency=afterok:JOB docs/deploy/slurm.sh CONFIG OUT       one run on one node
# CONFIG: a YAML file or the name of one that ships. OUT: a run folder that every node sees.
#SBATCH --job-name=cosfly
#SBATCH --nodes=2
#SBATCH --ntasks-per-node=1
#SBATCH --cpus-per-task=16
#SBATCH --gpus-per-node=1
#SBATCH --mem=64G
#SBATCH --time=24:00:00
#SBATCH --output=%x-%j.log
#SBATCH --open-mode=append
#SBATCH --requeue
set -euo pipefail

config=${1:?a configuration: a YAML file, or the name of one that ships}
out=${2:?a run folder that every node sees}
shift 2
# How cosfly and Ray are called on a node, as COSFLY="apptainer exec --nv cosfly.sif cosfly".
read -ra cosfly <<<"${COSFLY:-cosfly}"
read -ra ray <<<"${RAY:-ray}"
workers=${SLURM_CPUS_PER_TASK:-1}

one_town() {  # the stages up to captions, in the folder in which `cosfly run` of all towns looks for them
    local town=${1:?no town of this number: --array counts those that are named from 0}
    local folder=$out/$town others=()
    local take=(--config "$config" --town "$town")
    local map=$folder/simplify/step2_simplified.json traces=$folder/plan/drone_trace.json
    "${cosfly[@]}" maps "${take[@]}" --out "$folder/maps"
    "${cosfly[@]}" simplify "${take[@]}" --map "$folder/maps/boxes_3d.json" --out "$folder/simplify"
    "${cosfly[@]}" pedestrians "${take[@]}" --workers "$workers" --map "$map" --out "$folder/pedestrians"
    "${cosfly[@]}" plan "${take[@]}" --workers "$workers" --map "$map" --paths "$folder/pedestrians/path.json" --out "$folder/plan"
    [[ ! -f $folder/pedestrians/others.json ]] || others=(--others "$folder/pedestrians/others.json")
    "${cosfly[@]}" render "${take[@]}" --workers "$workers" --map "$folder/maps/boxes_3d.json" --simplified "$map" \
        --traces "$traces" "${others[@]}" --out "$folder/render"
    "${cosfly[@]}" inspect "${take[@]}" --workers "$workers" --map "$map" --traces "$traces" --data "$folder/render" --out "$folder/inspect"
    "${cosfly[@]}" caption "${take[@]}" --workers "$workers" --data "$folder/render" --out "$folder/caption"
}

on_ray() {
    local nodes head address running
    mapfile -t nodes < <(scontrol show hostnames "$SLURM_JOB_NODELIST")
    head=$(srun --nodes=1 --ntasks=1 --nodelist="${nodes[0]}" hostname --all-ip-addresses)
    address=${head%% *}:$((20000 + SLURM_JOB_ID % 10000))
    # srun of Slurm 22.05 to 23.02 does not take the CPUs of a task from the job.
    local step=(srun --nodes=1 --ntasks=1 "--cpus-per-task=$workers")
    # Ray asks for a token on any address but 127.0.0.1: one, which srun hands to every node with the environment.
    RAY_AUTH_TOKEN=$("${ray[@]}" get-auth-token --generate) && export RAY_AUTH_MODE=token RAY_AUTH_TOKEN
    trap 'kill $(jobs -p) 2>/dev/null || true; wait' EXIT
    local start=("${ray[@]}" start --block --disable-usage-stats "--num-cpus=$workers" "--num-gpus=${SLURM_GPUS_ON_NODE:-0}")
    "${step[@]}" --nodelist="${nodes[0]}" "${start[@]}" --head --node-ip-address="${address%:*}" --port="${address#*:}" &
    sleep 10
    for node in "${nodes[@]:1}"; do
        "${step[@]}" --nodelist="$node" "${start[@]}" --address="$address" &
    done
    for ((second = 0; second < 120; second += 5)); do
        running=$("${ray[@]}" status --address="$address" 2>/dev/null | grep -c " node_") || true
        if ((running == ${#nodes[@]})); then
            "${cosfly[@]}" run "$config" --out "$out" --engine ray --address "$address"
            return
        fi
        sleep 5
    done
    echo "error: ${running:-0} of ${#nodes[@]} nodes joined the Ray cluster at $address within two minutes; what each said stands above" >&2
    return 1
}

if [[ -n ${SLURM_ARRAY_TASK_ID:-} ]]; then
    one_town "${@:SLURM_ARRAY_TASK_ID+1:1}"
elif ((${SLURM_JOB_NUM_NODES:-1} > 1)); then
    on_ray
else
    "${cosfly[@]}" run "$config" --out "$out" --workers "$workers"
fi
