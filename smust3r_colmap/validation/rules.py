"""Rules: each looks at a described model for one thing and says what it found.

A rule is a function with a decorator; to add one, write it into the ``checks_*`` module where it belongs and into the
tuple ``RULES`` at the end of that module. It knows nothing of programs: ``readers`` says which rule affects which
program. The functions are pure and get whatever is there, so that a check of the images must cope with having no image
folder. The next module to read is ``checks_files``, then the others of that name.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum

from smust3r_colmap.validation.description import Subject


class Severity(IntEnum):
    """How bad a finding is; a finding is at least as bad as what it does to the readers asked for.

    FACT: not reported unless it affects a reader.
    NOTE: harmless.
    WARNING: a reader gives a worse result, or the model itself is doubtful.
    REFUSED: a reader stops or silently goes wrong; for a rule that is so by itself, every reader does.
    BROKEN: a file cannot be read to its end, so nothing can be made of the model.
    """

    FACT = 0
    NOTE = 1
    WARNING = 2
    REFUSED = 3
    BROKEN = 4


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """What a rule found.

    Args:
        count, of: how many things are concerned, and of how many; ``of`` is 0 where nothing is counted.
        unit: what is counted, as a plural.
        example: one of them, with the number at fault; may be empty.
    """

    count: int
    of: int
    unit: str
    example: str

    @property
    def text(self) -> str:
        """``3 of 40 images, such as 'a b.jpg'``."""
        counted = f"{self.count:,} of {self.of:,} {self.unit}" if self.of else ""
        if not (counted and self.example):
            return counted or self.example
        return f"{counted}, {'such as' if self.count > 1 else 'namely'} {self.example}"


Check = Callable[[Subject], Evidence | None]


@dataclass(frozen=True, kw_only=True)
class Rule:
    """One thing that may be wrong.

    Args:
        name: for programs and for the table of readers.
        title: what is wrong, for people.
        severity: whoever reads the model; readers may make it worse.
        advice: what to do.
        check: gives None where nothing is wrong.
    """

    name: str
    title: str
    severity: Severity
    advice: str
    check: Check


UNREAD_RULE = "file-unreadable"
"""Of a model with a file in which nothing can be read; most other rules would say that again in other words."""


def rule(name: str, title: str, *, severity: Severity, advice: str) -> Callable[[Check], Rule]:
    """Make the decorated function the check of a rule, which takes the function's name."""
    return lambda check: Rule(name=name, title=title, severity=severity, advice=advice, check=check)


def by_name(*rules: Rule) -> dict[str, Rule]:
    """The rules by their names, in the same order.

    Raises:
        ValueError: two have the same name.
    """
    named = {rule.name: rule for rule in rules}
    if len(named) < len(rules):
        raise ValueError("two rules have the same name")
    return named


def offenders(found: Sequence[str], *, of: int, unit: str) -> Evidence | None:
    """Evidence of the things ``found``, the first being the example; None where there are none."""
    return Evidence(count=len(found), of=of, unit=unit, example=found[0]) if found else None


def measured(text: str) -> Evidence:
    """Evidence that is one number, or one fact."""
    return Evidence(count=1, of=0, unit="", example=text)


def defects_as_evidence(subject: Subject, name: str) -> Evidence | None:
    """What the parsers found for the rule ``name``; the number of lines has no "of"."""
    found = [f"{defect.where}: {defect.text}" for defect in subject.model.defects if defect.rule == name]
    if not found:
        return None
    more = f" ({len(found)} such places)" if len(found) > 1 else ""
    return Evidence(count=len(found), of=0, unit="places", example=found[0] + more)


@dataclass(frozen=True, kw_only=True)
class Finding:
    """A rule that found something, and the readers that it affects.

    Args:
        severity: the worst of the rule's own and of what the readers do.
        refused_by, warned_by: why, by name of the reader.
    """

    rule: Rule
    evidence: Evidence
    severity: Severity
    refused_by: Mapping[str, str]
    warned_by: Mapping[str, str]


def apply_rules(subject: Subject, rules: Iterable[Rule]) -> dict[str, Evidence]:
    """What each rule found, by its name; those that found nothing are left out.

    Where nothing in a file can be read, only ``UNREAD_RULE`` is asked, and the rules that parsers noted defects for.
    """
    if subject.model.unread:
        asked = {UNREAD_RULE, *(defect.rule for defect in subject.model.defects)}
        rules = [rule for rule in rules if rule.name in asked]
    found = {rule.name: rule.check(subject) for rule in rules}
    return {name: evidence for name, evidence in found.items() if evidence is not None}
