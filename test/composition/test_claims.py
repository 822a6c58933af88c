"""Every claim is judged by numbers, the same ones each time."""

from dataclasses import replace

from needle_insertion.paper import claims, mismatch
from needle_insertion.paper.claims import Claim, FAILS, HOLDS, ONLY_IF, Tables
import pytest


@pytest.fixture(scope='module')
def found() -> list[Claim]:
    # Its verdicts are those of a thousand needles: what they rest on differs by factors.
    return claims.claims(study=mismatch.study(8))


def test_each_claim_has_a_verdict_with_evidence(found: list[Claim]) -> None:
    assert len(found) >= 40
    assert len({one.claim for one in found}) == len(found)
    for one in found:
        assert one.verdict in (HOLDS, ONLY_IF, FAILS)
        assert bool(one.condition) or one.verdict != ONLY_IF, one.claim
        assert any(letter.isdigit() for letter in one.evidence), one.claim
        assert one.numbers, one.claim


#: What is known of the paper beside this module: its equations page and docs/analysis.md.
KNOWN = {
    'M(q) is symmetric': HOLDS,
    'The first two rows of N': ONLY_IF,
    'Coriolis': ONLY_IF,
    'Without friction the system is conservative': ONLY_IF,
    'f_y enters the row of d with a plus': FAILS,
    'fully controllable': ONLY_IF,
    'not necessarily output controllable': ONLY_IF,
    'rank deficiency of 2': ONLY_IF,
    'q1 and q2 are observable': HOLDS,
    'leads to zero deflection': ONLY_IF,
    'nonzero position error': HOLDS,
    'informed by the model': ONLY_IF,
    'minimum needle deflection': FAILS,
}


@pytest.mark.parametrize('words', KNOWN)
def test_verdicts_are_those_that_the_equations_give(found: list[Claim], words: str) -> None:
    matching = [one for one in found if words in one.claim]
    assert [one.verdict for one in matching] == [KNOWN[words]]


def test_the_section_lists_all(found: list[Claim]) -> None:
    page = claims.section(found)
    assert len(page.tables[0].rows) == len(found)
    total = sum(int(word) for word in page.paragraphs[0].split() if word.isdigit())
    assert total == 2 * len(found)


def test_verdicts_on_tables_follow_what_is_identified() -> None:
    """A tissue that is a linear spring with little scatter makes the claims of Table 2 hold."""
    even = ((1.0,) * 5, (0.05,) * 5)
    none = ((0.0,) * 5, (0.05,) * 5)
    ideal = Tables(
        source='an ideal tissue',
        stiffness={'k_xx': even, 'k_zz': even, 'k_xz': none, 'k_zx': none},
    )
    for judge in (claims.consistency, claims.spring, claims.linear):
        assert judge(ideal).verdict == HOLDS
        assert judge(Tables()).verdict != HOLDS
        assert 'an ideal tissue' in judge(ideal).evidence
    assert claims.off_plane(ideal).verdict == FAILS
    assert claims.off_plane(Tables()).verdict == ONLY_IF
    far = replace(Tables(), friction={'mu_s': (0.8, 0.03), 'mu_v': (0.9, 0.04)})
    assert claims.identifiable(far).verdict == FAILS
    assert claims.reading_of_table_1(far).verdict == FAILS
    assert claims.reading_of_table_1(Tables()).verdict == ONLY_IF
