"""The smoother's graph solved from the truth: what it should have found from its own poses."""

import gtsam

from pipistrelle.estimation.smoother.graph import Best, landmark_key, links, pose_key


def from_the_truth(belief, path, places):
    """Return the best solution as the belief has it, and as it is reached from the true poses.

    `path` (k + 1, 3) holds the true pose at the start and after each step, `places` the true
    place of each landmark by its label.
    """
    values, step = gtsam.Values(), 0
    for link in links(belief.link):
        step += len(link.odometry.mean) if link.odometry else 0
        if not values.exists(pose_key(link.node)):
            values.insert(pose_key(link.node), gtsam.Pose2(*path[step]))
    for label in belief.mapped:
        values.insert(landmark_key(label), places[label])
    best = belief.solver.solve(belief.link)
    return best, Best(link=belief.link, graph=best.graph, found=values)
