% What rules find on this robot. What there is to ask: docs/robot/rules.md
% 'findings:' in fmea.yaml says which failure modes an answer speaks for.

% Charging has failed twice or more: something between the charger and the battery is broken.
charging_fails :-
    findall(Mission, ( mission_name(Mission, charging), mission(Mission, failed, _, _) ), Missions),
    length(Missions, Count),
    Count >= 2.

% A part is in error, and so are two or more of the components that need it.
common_cause(Part) :-
    component(Part),
    in_error(Part),
    findall(Component, ( needs(Component, Part), in_error(Component) ), Components),
    length(Components, Count),
    Count >= 2.

% Something is wrong with a component now.
in_error(Component) :-
    now(Time),
    status(Component, error, Time, Time).
