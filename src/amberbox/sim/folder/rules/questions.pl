% Questions for people, such as:
%
%   amberbox rules --where FOLDER --ask 'failed_on_low_battery(Mission)' --why
%
% Rules in files called questions*.pl are never asked by a diagnosis.

% Missions that failed while the battery was below 20 %, for some time at least.
failed_on_low_battery(Mission) :-
    mission(Mission, failed, From, To),
    holds('sim_battery.percentage < 20', From, To).

% Missions that failed, and what was in error meanwhile.
failed_with(Mission, Component) :-
    mission(Mission, failed, From, To),
    status(Component, error, From, To).

% A wheel unit is in error and the others are not: it is no fault that they share.
odd_one_out(Wheel) :-
    type(Wheel, wheel_unit),
    in_error(Wheel),
    \+ ( type(Other, wheel_unit), Other \== Wheel, in_error(Other) ).

% What may stop the robot without anything that shows it.
unseen(Component, Mode) :-
    failure_mode(Component, Mode),
    severity(Component, Mode, Severity),
    member(Severity, [critical, fatal]),
    \+ shows(Component, Mode, _).
