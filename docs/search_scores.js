// Guides before results, and pages before symbols of the code: a reader who knows the name of a
// symbol finds it by that name.
const LATER = /^(association|estimators|findings|readings|robustness|timing|glossary|extending)$/;
var Scorer = {
  score: ([page, title, anchor, about, score]) =>
    score - (page.startsWith("api/") ? 100 : LATER.test(page) ? 10 : 0),
  objNameMatch: 11,
  objPartialMatch: 6,
  objPrio: { 0: 15, 1: 5, 2: -5 },
  objPrioDefault: 0,
  title: 15,
  partialTitle: 7,
  term: 5,
  partialTerm: 2,
};
