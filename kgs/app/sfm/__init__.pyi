from .pose import pose_photos as pose_photos
