"""The whole suite in one command: generate, publish the hash, diagnose, compare, score."""

import argparse
from pathlib import Path

from benchmarks.concealed import followup, generate, ideal, peers, run, score
from benchmarks.concealed.workers import read

SMALL = 16


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.concealed", description=__doc__)
    parser.add_argument("--cases", type=int, default=300)
    parser.add_argument(
        "--seed", type=int, default=generate.FIRST_TEST_SEED,
        help=f"below {generate.FIRST_TEST_SEED}: development, without the late families; from "
        f"{generate.NEWEST_SEED} on the newest families alone, from {generate.FRESH_SEED} on the fresh ones, from "
        f"{generate.UNSEEN_SEED} on the unseen ones, from {generate.BLIND_SEED} on the blind ones",
    )  # fmt: skip
    parser.add_argument("--out", type=Path, default=Path("outputs/concealed"))
    parser.add_argument("--small", action="store_true", help=f"{SMALL} cases, without peers and follow-ups")
    parser.add_argument("--no-peers", action="store_true")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--limit", type=float, default=180.0, help="seconds a case")
    given = parser.parse_args()
    cases = SMALL if given.small else given.cases
    if not (given.out / "answers.json").exists():
        generate.generate(given.out, cases, given.seed)
    print("SHA-256 of the answers:", (given.out / "answers.sha256").read_text().strip(), flush=True)
    run.run(given.out, workers=given.workers, limit=given.limit)
    print(f"{len(read(given.out / 'results.jsonl'))} cases diagnosed", flush=True)
    if not given.small:
        followup.experiments(given.out, workers=given.workers, limit=given.limit)
        followup.limits(given.out, workers=given.workers, limit=given.limit)
        ideal.run(given.out, workers=given.workers)
        if not given.no_peers:
            peers.run(given.out, workers=given.workers)
    print(score.score(given.out))


if __name__ == "__main__":
    main()
