// Pages before symbols of the code: a reader who knows the name of a symbol finds it by that name.
var Scorer = {
  score: ([page, title, anchor, about, score]) => (page.startsWith("api/") ? score - 100 : score),
  objNameMatch: 11,
  objPartialMatch: 6,
  objPrio: { 0: 15, 1: 5, 2: -5 },
  objPrioDefault: 0,
  title: 15,
  partialTitle: 7,
  term: 5,
  partialTerm: 2,
};
