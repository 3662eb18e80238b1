#!/usr/bin/python3
"""A robot on rospy that is commanded: topics, services and action servers of the real packages.

Usage: commanded.py OUT. Each line of OUT is a JSON object: what was received, and by whom.

Topics: /cmd_vel (Twist), /path (nav_msgs/Path), /goal_only (move_base_msgs/MoveBaseGoal, a type
that Amberbox does not know). Services: /trigger, /set (SetBool), /plan (nav_msgs/GetPlan), /fail
raises, /hang never answers, /die kills the node. Action servers: /test (actionlib/Test; the goal is
what happens) and /move_base.
"""

from __future__ import annotations

import json
import os
import sys
import threading
import time
from typing import Any

import actionlib
import rospy
from actionlib.msg import TestAction, TestFeedback, TestResult
from actionlib_msgs.msg import GoalID  # type: ignore[import-not-found]  # a package of Debian
from geometry_msgs.msg import PoseStamped, Twist
from move_base_msgs.msg import MoveBaseAction, MoveBaseGoal
from nav_msgs.msg import Path as RosPath
from nav_msgs.srv import GetPlan, GetPlanResponse
from std_srvs.srv import SetBool, SetBoolResponse, Trigger, TriggerResponse

SUCCEED, ABORT, UNTIL_PREEMPTED, DIE, IGNORE_CANCEL = 1, 2, 3, 4, 5


def note(**fields: Any) -> None:
    """Write down one event at once."""
    OUT.write(json.dumps(fields) + "\n")
    OUT.flush()


def on_twist(message: Any) -> None:
    caller = message._connection_header["callerid"]
    note(topic="/cmd_vel", x=message.linear.x, z=message.angular.z, caller=caller, t=time.time())


def on_path(message: Any) -> None:
    places = [[p.pose.position.x, p.header.frame_id] for p in message.poses]
    note(topic="/path", frame=message.header.frame_id, poses=places, secs=message.header.stamp.secs)


def on_goal_only(message: Any) -> None:
    note(topic="/goal_only", x=message.target_pose.pose.position.x)


def on_cancel(message: Any) -> None:
    note(cancel=True, id=message.id)


def on_set(request: Any) -> Any:
    note(service="/set", data=request.data)
    return SetBoolResponse(success=request.data, message=f"is {request.data}")


def on_trigger(request: Any) -> Any:
    note(service="/trigger")
    return TriggerResponse(success=True, message="done")


def on_plan(request: Any) -> Any:
    response = GetPlanResponse()
    response.plan.header.frame_id = request.start.header.frame_id
    for x in (request.start.pose.position.x, request.goal.pose.position.x):
        pose = PoseStamped()
        pose.pose.position.x = x
        response.plan.poses.append(pose)
    return response


def on_fail(request: Any) -> Any:
    raise rospy.ServiceException("the arm is\nstuck")


def on_hang(request: Any) -> Any:
    note(service="/hang")
    threading.Event().wait()


def on_die(request: Any) -> Any:
    note(service="/die")
    os._exit(1)


def execute_test(goal: Any) -> None:
    note(action="/test", goal=goal.goal, id=TEST.current_goal.get_goal_id().id)
    TEST.publish_feedback(TestFeedback(feedback=goal.goal * 10))
    if goal.goal == SUCCEED:
        TEST.set_succeeded(TestResult(result=42), "well done")
    elif goal.goal == ABORT:
        TEST.set_aborted(TestResult(result=-1), "a wheel\nis blocked")
    elif goal.goal == UNTIL_PREEMPTED:
        while not TEST.is_preempt_requested():
            time.sleep(0.005)
        note(action="/test", preempted=True, t=time.time())
        TEST.set_preempted(TestResult(result=7), "stopped")
    elif goal.goal == DIE:
        os._exit(1)
    else:
        threading.Event().wait()


def execute_move_base(goal: Any) -> None:
    pose = goal.target_pose
    note(action="/move_base", x=pose.pose.position.x, frame=pose.header.frame_id)
    MOVE_BASE.set_succeeded()


OUT = open(sys.argv[1], "w")  # noqa: SIM115, PTH123  # as long as the process lives
rospy.init_node("commanded", disable_signals=True)
rospy.Subscriber("/cmd_vel", Twist, on_twist, queue_size=1000)
rospy.Subscriber("/path", RosPath, on_path)
rospy.Subscriber("/goal_only", MoveBaseGoal, on_goal_only)
rospy.Subscriber("/test/cancel", GoalID, on_cancel)
for name, kind, handler in (
    ("/trigger", Trigger, on_trigger),
    ("/set", SetBool, on_set),
    ("/plan", GetPlan, on_plan),
    ("/fail", Trigger, on_fail),
    ("/hang", Trigger, on_hang),
    ("/die", Trigger, on_die),
):
    rospy.Service(name, kind, handler)
TEST = actionlib.SimpleActionServer("/test", TestAction, execute_test, auto_start=False)
MOVE_BASE = actionlib.SimpleActionServer(
    "/move_base", MoveBaseAction, execute_move_base, auto_start=False
)
TEST.start()
MOVE_BASE.start()
note(ready=True)
rospy.spin()
