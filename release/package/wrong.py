"""What is wrong with the material of a release: all of it is looked for before the stage gives up."""

from __future__ import annotations

from cosfly.errors import CosflyError, InputError, VerifyError
from cosfly.work.stage_folder import Failed, StageFolder, write_failures

NUM_NAMED = 10  # things that are wrong, in a message; failures.jsonl has all


class Findings:
    """Takes what is wrong, and refuses to go on."""

    def __init__(self, stage: StageFolder) -> None:
        self._stage, self.failures = stage, list[Failed]()

    def tell(self, item_id: str, error: CosflyError) -> None:
        self.failures.append(Failed(id=item_id, code=error.code, message=str(error)))

    def check(self) -> None:
        """Refuse to go on if anything is wrong.

        Raises:
            InputError, VerifyError: names the first findings; `failures.jsonl` has all.
        """
        if not self.failures:
            return
        path = self._stage.path / "failures.jsonl"
        write_failures(path, self.failures)
        listed = [failure.message for failure in self.failures[:NUM_NAMED]]
        more = f" | and {len(self.failures) - NUM_NAMED} more, see {path}" if len(self.failures) > NUM_NAMED else ""
        kind = VerifyError if all(failure.code == VerifyError.code for failure in self.failures) else InputError
        wrong = "1 thing is" if len(self.failures) == 1 else f"{len(self.failures)} things are"
        raise kind(
            f"nothing is released: {wrong} wrong with the material", where=self._stage.path,
            got=" | ".join(listed) + more, fix="mend them, or leave the flights out, and run the same command again: finished shards are kept",
        )  # fmt: skip
