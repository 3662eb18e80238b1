// The page of a robot's diagnosis: its card, and the details a tab at a time.

import { one } from "../dom.js";
import { keep } from "./card.js";
import * as details from "./details.js";
import { listen } from "../feed.js";
import { fieldStamp, fieldText } from "../time.js";
import * as view from "../view.js";

const page = one("#dx");
const robot = page.dataset.robot;
const base = `/robots/${encodeURIComponent(robot)}/diagnosis`;
const place = one("#dx-card");

/** Return the address of a part, of the diagnosis and the moment that the page is about. */
function part(name, more = []) {
  const query = new URLSearchParams(["diagnosis", "at"].map((key) => [key, view.get(key)]).filter(([, value]) => value));
  for (const [key, value] of more) query.append(key, value);
  const text = query.toString();
  return `${base}/${name}${text ? `?${text}` : ""}`;
}

/** Show the diagnosis as of another moment: the whole page is about that. */
function chooseMoment(event) {
  event.preventDefault();
  const { value } = event.target.elements.at;
  const query = new URLSearchParams(location.search);
  for (const key of ["diagnosis", "at"]) query.delete(key);
  if (value) query.set("at", fieldStamp(value));
  location.assign(`${base}?${query}`);
}

function startMoment() {
  const form = one("#dx-moment");
  const { at } = one("[name=at]", form).dataset;
  form.elements.at.value = fieldText(Date.parse(at));
  form.addEventListener("submit", chooseMoment);
}

if (place) {
  const feed = view.get("at") ? null : listen({ robots: [robot], kinds: ["diagnosis", "presence"] });
  const tab = details.start({ part, renewed: () => renew() });
  const renew = keep(place, { path: () => part("card"), feed, renewed: tab.renew, robot });
  startMoment();
  view.on(tab.show);
}
